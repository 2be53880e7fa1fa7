"""The report of a run as a page: what stands in it, that nothing in it can do harm, and that a browser draws it."""

import base64
import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest

from cluster.cli.main import run as run_command
from cluster.config.campaign_config import CampaignConfig
from cluster.evaluation.published import published
from cluster.reporting.clouds import TANGENT, CloudView, draw_panels, tried
from cluster.reporting.collecting import wilson
from cluster.reporting.counterfactuals import Counterfactuals, hinge_twins, variations
from cluster.reporting.page import MAX_TEXT, Drawing, Page, Section, plain, render, shortened
from cluster.reporting.results import Results, like_for_like, table_of
from cluster.reporting.training import after_tries, curves_of, read_entries
from cluster.reporting.trial_sections import EvaluationTrial, FailedExploit, first_trials, most_telling, varied
from cluster.runs.run_folder import ObjectsUsed, RunFolder, begin
from cluster.runs.run_log import RunLog
from learner.evaluation.table import EvaluationRow
from shared.config import CameraConfig, CollectionConfig, RolloutConfig
from shared.errors import StoreError
from shared.plan import EvaluationConfig, Job, ObjectRef, Plan, RolloutRecord, Setting
from shared.policies.adaptation import Adapter
from shared.policies.methods import METHODS
from shared.policies.policy import Policy
from shared.store import Store
from shared.tasks import TASKS, task_named
from shared.types import OutcomeKind, Role
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.small_networks import TINY
from tests.support.small_policies import history_of, observation_of, policy_of

ATTACK = "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"
"""Stands wherever a file can say what it likes: categories, reasons, stages, methods, names of metrics."""
BROWSER = shutil.which("chromium")


class Elements(HTMLParser):
    """Elements of a page, each with its attributes, and what scripts hold."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[str | None, str]] = []
        self._script: str | None = None
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((dict(attrs).get("type"), ""))

    def handle_data(self, data: str) -> None:
        if self.found and self.found[-1][0] == "script":
            kind, text = self.scripts[-1]
            self.scripts[-1] = kind, text + data

    def handle_endtag(self, tag: str) -> None:
        self.found.append((f"/{tag}", {}))

    @property
    def executable(self) -> list[str]:
        """Scripts that a browser runs."""
        return [text for kind, text in self.scripts if kind != "application/json"]

    @property
    def figures(self) -> list[dict[str, Any]]:
        """What is drawn."""
        return [json.loads(text) for kind, text in self.scripts if kind == "application/json"]


def strings(value: object) -> Iterator[str]:
    """All texts in a document of JSON."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for name, each in value.items():
            yield from strings(name)
            yield from strings(each)
    elif isinstance(value, list):
        for each in value:
            yield from strings(each)


# A run as a campaign leaves it, of hostile files


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = tmp_path_factory.mktemp("report") / "run"
    made = begin(folder, CampaignConfig(task="push"))
    refs = tuple(ref.model_copy(update={"category": ATTACK}) for ref in fabricate_setting(4).objects)
    used = ObjectsUsed(folder=ATTACK, train=refs[:2], validation=(), test=refs[2:], refused=((ATTACK, ATTACK),))
    made.objects_file.write_text(used.model_dump_json())
    base = fabricate_setting(points=64)
    collected = base.model_copy(update={"objects": refs[:2]})
    evaluated = base.model_copy(
        update={
            "kind": "evaluation",
            "objects": refs[2:],
            "evaluation": EvaluationConfig(methods=("where2act", "ours-final"), budgets=(1, 2), queries=2),
        }
    )
    fill(made.store, Plan(setting=collected), 4).publish_policy(1, policy_of().to_files())
    fill(made.evaluation, Plan(setting=evaluated, proposer="evaluation", policy_version=1), 4)
    write_trainings(made)
    run_log = RunLog(made.log)
    tally = {"interactions": 32, "seconds": {"total": 2.0, "simulate": 1.5, ATTACK: 0.5}}
    for stage, result in (("collect-random", {"tally": tally}), (f"train-{ATTACK}", {}), ("evaluate", {})):
        with run_log.stage(stage) as done:
            done(result)
    return made


def fill(path: Path, plan: Plan, count: int) -> Store:
    job = Job(plan.key, 0, count)
    rollouts = fabricate_rollouts(plan, job, interactions=8, per_observation=2)
    if plan.setting.kind == "evaluation":
        rollouts = [as_evaluated(rollout) for rollout in rollouts]
    store = Store.create(path, plan.setting)
    store.commit(plan, job, rollouts, {})
    return store


def as_evaluated(rollout: RolloutRecord) -> RolloutRecord:
    """The same rows in the roles that an evaluation gives them."""
    ours = "ours-final"
    roles = [(Role.QUERY, "", -1)] * 2 + [(Role.EXPLOIT, "where2act", 1), (Role.EXPLOIT, "where2act", 2)]
    roles += [(Role.CONTEXT, ours, -1), (Role.EXPLOIT, ours, 1), (Role.CONTEXT, ours, -1), (Role.EXPLOIT, ours, 2)]
    rows = [
        dataclasses.replace(row, role=role, method=method, budget=budget)
        for row, (role, method, budget) in zip(rollout.interactions, roles, strict=True)
    ]
    return dataclasses.replace(rollout, interactions=tuple(rows))


def write_trainings(made: RunFolder) -> None:
    rows = [row_of(method, budget) for method in ("where2act", "ours-final", ATTACK[:100]) for budget in (1, 2)]
    for stage, name, text in (
        ("evaluate", "results.json", json.dumps({"objects": 3, "rows": [row.model_dump() for row in rows]})),
        ("prior", "metrics.jsonl", json.dumps({"step": 5, "score": 0.5, f"loss_{ATTACK}": 0.4})),
    ):
        made.training(stage).mkdir(parents=True)
        (made.training(stage) / name).write_text(text)


def row_of(method: str, budget: int, f_score: float | None = 0.5, sample_success: float | None = 0.25) -> EvaluationRow:
    return EvaluationRow(
        method=method,
        budget=budget,
        f_score=f_score,
        f_score_low=0.4,
        f_score_high=0.625,
        sample_success=sample_success,
        trials=8,
        best_f=0.6,
        bce=0.5,
        auc=0.7,
        base_rate=0.3,
        queries=10,
        mean_tries=float(budget),
    )


@pytest.fixture(scope="module")
def html(run: RunFolder) -> str:
    assert run_command(["report", str(run.path), "--no-experiments"]) == 0
    return run.page.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def elements(html: str) -> Elements:
    return Elements(html)


def test_the_page_runs_its_two_scripts_and_no_other(html: str, elements: Elements) -> None:
    assert len(elements.executable) == 2
    policy = next(attributes["content"] for tag, attributes in elements.found if "http-equiv" in attributes)
    assert policy is not None
    allowed = re.findall(r"'sha256-([^']+)'", policy)
    assert allowed == [
        base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in elements.executable
    ]
    assert "default-src 'none'" in policy
    assert "unsafe-inline" not in policy.split("script-src")[1]
    assert "taken" in html, "the attack is in the page, as text"


def test_no_element_listens_or_asks_the_network(elements: Elements) -> None:
    for tag, attributes in elements.found:
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
        for name in ("src", "href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/png;base64,")), (tag, attributes)


def test_no_text_of_a_figure_holds_a_tag_but_ours(elements: Elements) -> None:
    assert len(elements.figures) >= 6
    for figure in elements.figures:
        for text in strings(figure):
            rest = re.sub(r"<br>|<extra></extra>", "", text)
            assert "<" not in rest, text


def test_the_page_shows_everything_and_stays_small(html: str, elements: Elements) -> None:
    keys = [attributes["id"] for tag, attributes in elements.found if tag == "section"]
    assert keys == ["glance", "results", "proposals", "hidden-facts", "failures", "training", "collection"]
    assert len(html) < 10 << 20
    assert html.count("plotly.js v") == 1
    assert "40\u201362" in html, "the interval of the F-score, percent"
    assert "evaluated on 3 others" in html, "the objects that there were trials of"
    assert "adaafford report" in html, "how to have the hidden facts tried"


def test_the_terminal_still_shows_the_table(run: RunFolder, html: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["report", str(run.path), "--no-experiments"]) == 0
    shown = capsys.readouterr().out
    assert "ours-final" in shown
    assert run.page.name in shown.replace("\n", "")


def test_results_that_are_none_are_one_line(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    path = run.training("evaluate") / "results.json"
    kept = path.read_text()
    try:
        path.write_text(json.dumps({"objects": 1, "rows": [{"method": "ours-final", "budget": "many"}]}))
        assert run_command(["report", str(run.path), "--no-experiments"]) == 2
        assert "rows.0.budget" in capsys.readouterr().err
    finally:
        path.write_text(kept)


def browsed(page: Path, profile: Path) -> subprocess.CompletedProcess[str]:
    """What a browser makes of a page: the document as it stands in the end, and what it says on its console."""
    assert BROWSER is not None
    flags = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags += ["--window-size=1300,6000", "--virtual-time-budget=2000000", "--enable-logging=stderr"]
    command = [BROWSER, *flags, f"--user-data-dir={profile}", "--dump-dom", page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
def test_a_browser_draws_every_figure_and_obeys_no_text(run: RunFolder, html: str, tmp_path: Path) -> None:
    seen = browsed(run.page, tmp_path)
    drawn = Elements(seen.stdout)
    classes = [(attributes.get("class") or "").split() for tag, attributes in drawn.found if tag == "div"]
    plots = [names for names in classes if "plot" in names]
    assert len(plots) == len(Elements(html).figures)
    assert all("js-plotly-plot" in names and "failed" not in names for names in plots)
    assert "<title>AdaAfford: push</title>" in seen.stdout
    assert "Content Security Policy" not in seen.stderr, "nothing even tried"


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
def test_in_a_browser_tabs_change_the_figure_and_its_clouds_turn_together(tmp_path: Path) -> None:
    panel = CloudView("a", observation_of(), np.zeros(200, np.float32))
    drawings = [Drawing(draw_panels([panel] * 3, 3, ("a",)), tab=name, solid=True) for name in ("one", "two")]
    page = render(Page("a", "b", (), (Section("s", "t", drawings=tuple(drawings)),)))
    # The visitor is a script, which the page's policy would not let in.
    page = re.sub(r"<meta http-equiv[^>]*>", "", page)
    (tmp_path / "page.html").write_text(f"{page}<script>{VISITOR}</script>", encoding="utf-8")
    title = re.search(r"<title>(.*?)</title>", browsed(tmp_path / "page.html", tmp_path / "profile").stdout)
    assert title is not None
    assert json.loads(title[1]) == [True, False, False, True, [9, 9, 9]]


VISITOR = """
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const drawn = () => [...document.querySelectorAll(".plot")].map((node) => !!node.dataset.drawn && !!node._fullLayout);
const until = async (met) => { for (let k = 0; k < 9000 && !met(); k++) await wait(100); };
(async () => {
  await until(() => drawn()[0]);
  const before = drawn();
  document.querySelectorAll(".tabs button")[1].click();
  const node = document.querySelectorAll(".plot")[1];
  await until(() => drawn()[1] && !drawn()[0] && node._ev && node._ev.listenerCount("plotly_relayout"));
  const after = drawn();
  const camera = { eye: { x: 9, y: 0, z: 0 }, up: { x: 0, y: 0, z: 1 }, center: { x: 0, y: 0, z: 0 } };
  node.emit("plotly_relayout", { "scene2.camera": camera });
  const eyes = () => ["scene", "scene2", "scene3"].map((name) => node.layout[name].camera.eye.x);
  await until(() => eyes().every((x) => x === 9));
  document.title = JSON.stringify([...before, ...after, eyes()]);
})().catch((error) => { document.title = JSON.stringify(String(error)); });
"""
"""Looks, clicks on the second tab, looks again, and turns its second cloud."""


# Pages


def test_an_empty_page_is_a_page() -> None:
    page = render(Page(ATTACK, ATTACK, (), (Section("a", ATTACK, (ATTACK,)),), ((ATTACK, ATTACK),)))
    assert len(Elements(page).executable) == 2


def test_a_figure_cannot_end_its_script() -> None:
    figure = go.Figure(go.Bar(x=[ATTACK], y=[1]))
    text = Drawing(figure).json
    assert "<" not in text
    assert json.loads(text)["data"][0]["x"] == [ATTACK]


def test_texts_are_one_line_of_bounded_length() -> None:
    assert shortened("a\n b\t c") == "a b c"
    assert len(shortened("x" * 10_000)) == MAX_TEXT
    assert plain("<b>%{x}</b>") == "&lt;b&gt;&#37;{x}&lt;/b&gt;"


# Results


def test_the_paper_has_figures_for_every_task_and_method() -> None:
    for task in TASKS.names():
        for method in METHODS.names():
            if METHODS.get(method).reference:
                continue
            told = published(task, novel_categories=False)[method]
            assert all(0 < (told.at(budget, "f_score") or 0) < 100 for budget in (1, 2, 4))
            assert told.at(3, "f_score") is None or len(told.f_score) == 1
    assert published("pull-closed-door", novel_categories=False)["ours-final"].at(4, "sample_success") == 22.14
    assert published("push", novel_categories=True)["where2act"].at(2, "f_score") == 59.95
    assert not published("push-faucet", novel_categories=True)


def test_the_best_of_a_column_is_marked_and_the_oracle_never() -> None:
    rows = (row_of("where2act", 1, 0.2), row_of("ours-final", 1, 0.6, None), row_of("oracle", 0, 0.9, None))
    table = table_of(Results(task="push-faucet", objects=1, rows=rows))
    marks = {cells[0].text: [cell.kind for cell in cells[1:]] for cells in table.body}
    assert marks["ours-final"][0] == "best"
    assert marks["where2act"] == ["", "paper", "best", "paper", ""]
    assert "best" not in marks["oracle"]
    cells = {cells[0].text: cells for cells in table.body}["ours-final"]
    assert (cells[1].text, cells[1].note, cells[2].text, cells[3].text) == ("60.0", "40\u201362", "77.4", "")


def test_a_task_that_the_paper_lacks_has_no_columns_of_it() -> None:
    table = table_of(Results(task="another", objects=1, rows=(row_of("ours-final", 1),)))
    assert [len(row) for row in table.body] == [4]
    assert sum(cell.span for cell in table.head[0]) == len(table.head[1]) == 4


def test_what_was_measured_as_in_the_paper_stands_in_a_table_beside_it() -> None:
    row = row_of("ours-final", 1)
    assert like_for_like(Results(task="push-faucet", objects=1, rows=(row,))) == ()  # Files of older versions.
    measured = {"mix_f_score": 0.8, "mix_f_score_low": 0.7, "mix_f_score_high": 0.9, "mix_base_rate": 0.45}
    (table,) = like_for_like(Results(task="push-faucet", objects=1, rows=(row.model_copy(update=measured),)))
    assert [cell.text for cell in table.head[0]] == ["method", "F, published mix"]
    (cells,) = table.body
    assert [(cell.text, cell.note) for cell in cells[1:]] == [("80.0", "70\u201390"), ("77.4", "")]
    assert "45.0% succeed" in table.caption


# Curves and statistics


def test_metrics_that_a_kill_tore_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    lines = [
        '{"step": 1, "score": 0.5, "loss_a": 2, "auc": 0.9}',
        "[1]",
        '{"step": "x", "score": 1}',
        f'{{"step": 1{"0" * 999}, "score": 1}}',
    ]
    path.write_text("\n".join([*lines, '{"step": 2, "score": NaN}', '{"step": 3, "score": 0.25, "lo']))
    assert curves_of(read_entries(path)) == {"score": ([1], [0.5]), "loss_a": ([1], [2.0])}


def test_what_a_validation_says_after_tries_is_found_by_their_number() -> None:
    entry = {"step": 9.0, "bce_after_8": 0.1, "bce_after_0": 0.5, "bce_after_x": 1.0, "auc_after_0": 0.7}
    assert after_tries(entry, "bce") == [(0, 0.5), (8, 0.1)]
    assert after_tries(entry, "f_score") == []


def test_a_huge_file_of_metrics_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    with path.open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(StoreError, match="larger than"):
        read_entries(path)


def test_wilsons_interval_holds_the_share_and_narrows() -> None:
    for share in (0.0, 0.1, 0.5, 1.0):
        widths = []
        for count in (10, 100, 1000):
            low, high = wilson(round(share * count), count)
            assert 0 <= low <= share <= high <= 1
            widths.append(high - low)
        assert widths == sorted(widths, reverse=True)
    assert wilson(0, 0) == (0.0, 1.0)


# Clouds


def test_clouds_of_a_figure_share_frame_and_eye_and_none_is_cut_off() -> None:
    panels = []
    for seed in range(3):
        observation = observation_of(seed)
        arrows = tuple(tried(interaction) for interaction in history_of(observation, 2, seed))
        panels.append(CloudView("a", observation, np.linspace(0, 1, 200, dtype=np.float32), arrows))
    figure = draw_panels(panels, 3, ("affordance",))
    scenes = list(figure.select_scenes())
    assert len(scenes) == 3
    frames = [(s.camera, s.aspectratio, s.xaxis.range, s.yaxis.range, s.zaxis.range) for s in scenes]
    assert all(frame == frames[0] for frame in frames)
    low, high = np.array([axis.range for axis in (scenes[0].xaxis, scenes[0].yaxis, scenes[0].zaxis)]).T
    eye = np.array([scenes[0].camera.eye[name] for name in "xyz"])
    up = panels[0].observation.world_from_camera[:3, 2]
    toward = eye / np.linalg.norm(eye)
    for panel in panels:
        tails = [i.action.point - 0.3 * i.action.approach for i in panel.arrows]
        points = np.concatenate([panel.observation.points, tails])
        assert (points >= low - 1e-6).all()
        assert (points <= high + 1e-6).all()
        seen = (points - (low + high) / 2) / (high - low).max()
        depth = np.linalg.norm(eye) - seen @ toward
        assert (np.abs(seen @ up) <= TANGENT * depth + 1e-6).all()


def test_an_arrow_ends_where_the_gripper_touches() -> None:
    observation = observation_of()
    interaction = history_of(observation, 1)[0]
    figure = draw_panels([CloudView("a", observation, np.zeros(200, np.float32), (tried(interaction),))], 1, ("a",))
    cone = next(trace for trace in figure.data if trace.type == "cone")
    assert (cone.x[0], cone.y[0], cone.z[0]) == tuple(interaction.action.point)
    assert (cone.u[0], cone.v[0], cone.w[0]) == tuple(interaction.action.approach)


# Episodes and failures


def test_an_trial_is_what_one_method_did(run: RunFolder) -> None:
    found = first_trials(Store.open(run.evaluation))
    assert len(found) == 4
    for trial in found:
        assert [row.step for row in trial.tries] == [4, 6]
        assert [row.budget for row in trial.exploits] == [1, 2]
        assert [len(trial.before(row)) for row in trial.exploits] == [1, 2]
        assert trial.history[0].observation is trial.rollout.observations[trial.tries[0].observation]
    assert most_telling(found, Adapter(policy_of())) in found
    assert most_telling([], Adapter(policy_of())) is None
    assert len(first_trials(Store.open(run.evaluation), 2)) == 2


def test_failures_come_one_of_a_kind_first_and_the_most_believed_before_others(run: RunFolder) -> None:
    trial = first_trials(Store.open(run.evaluation))[0]
    kinds = [OutcomeKind.NO_GRASP, OutcomeKind.NO_GRASP, OutcomeKind.NO_GRASP, OutcomeKind.OK, OutcomeKind.WRONG_PART]
    failures = [failure_of(trial, kind, belief) for kind, belief in zip(kinds, (0.9, 0.8, 0.7, 0.1, 0.2), strict=True)]
    shown = [(failure.row.outcome.kind, failure.belief) for failure in varied(failures)]
    assert shown == [(kinds[0], 0.9), (kinds[4], 0.2), (kinds[3], 0.1), (kinds[1], 0.8)]


def failure_of(trial: EvaluationTrial, kind: OutcomeKind, belief: float) -> FailedExploit:
    row = trial.exploits[-1]
    outcome = dataclasses.replace(row.outcome, kind=kind, success=False)
    return FailedExploit(trial, dataclasses.replace(row, outcome=outcome), belief)


# Hidden facts


def door_setting(task: str = "pull-closed-door") -> Setting:
    camera = CameraConfig(image_size=256, points=256, candidates=4000)
    collection = CollectionConfig(camera=camera, rollout=RolloutConfig())
    ref = ObjectRef(id="a", category="StorageFurniture", content_hash="0" * 64)
    return Setting(
        kind="evaluation",
        task=task,
        seed=3,
        objects=(ref,),
        collection=task_named(task).resolve(collection),
        evaluation=EvaluationConfig(),
    )


def test_one_hidden_fact_is_varied_at_a_time(tmp_path: Path) -> None:
    setting = door_setting()
    twins = hinge_twins(setting, tmp_path)
    found = {variation.name: variation for variation in variations(setting, twins[0], twins)}
    assert list(found) == ["part mass", "joint friction", "surface friction", "hinge side"]
    for variation in found.values():
        facts = [(*each.dynamics.values.values(), each.target.ref) for each in variation.cases]
        assert sum(len(set(values)) > 1 for values in zip(*facts, strict=True)) == 1
    ranges = setting.terms.dynamics
    values = [case.dynamics["joint_friction"] for case in found["joint friction"].cases]
    assert values == sorted(values)
    assert (values[0], values[2]) == (ranges["joint_friction"].low, ranges["joint_friction"].high)


def test_only_faucets_hide_their_direction_and_only_cabinets_their_hinge(tmp_path: Path) -> None:
    setting = door_setting("push-faucet")
    assert hinge_twins(setting, tmp_path) == []
    target = hinge_twins(door_setting(), tmp_path)[0]
    directions = variations(setting, target, [])[-1]
    assert directions.name == "direction"
    assert len({case.dynamics.direction for case in directions.cases}) == 3


def test_twins_look_alike_and_are_tried_alike(tmp_path: Path) -> None:
    setting = door_setting()
    twins = hinge_twins(setting, tmp_path)
    policy = Policy.untrained(setting.task, TINY, 0).with_trained("prior").with_trained("aap").with_trained("aip")
    counterfactuals = Counterfactuals(setting, Adapter(policy))
    left, right = counterfactuals.posteriors(variations(setting, twins[0], twins)[-1])
    assert (left.label, right.label) == ("hinge on the left", "hinge on the right")
    assert np.array_equal(left.observation.points, right.observation.points)
    for one, other in zip(left.history, right.history, strict=True):
        assert one.action.point_index == other.action.point_index
        assert np.array_equal(one.action.rotation, other.action.rotation)
    for posterior in (left, right):
        assert posterior.affordance.shape == (256,)
        assert ((posterior.affordance >= 0) & (posterior.affordance <= 1)).all()
