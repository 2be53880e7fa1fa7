"""docs/results/README.md repeats figures of its own tables, and of the files that evaluations wrote."""

import re
from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[2] / "docs/results"
PAGE = (RESULTS / "README.md").read_text()
TASKS = ("push", "pull", "pull-closed-door", "push-faucet")
METHODS = {"Where2Act": "where2act", "AAP": "aap-no-tries", "furthest points": "ours-fps", "AIP": "ours-final"}
COLUMNS = {2: "BCE", 3: "F-score", 4: "F, published mix", 5: "F, published mix, shifted", 7: "from the start"}
BEST_SHARE = 8


def section(task: str) -> str:
    """The part of the page about a task."""
    return PAGE.partition(f"\n### {task}\n")[2].partition("\n### ")[0]


def rows(text: str, width: int) -> list[list[str]]:
    """The rows of tables of so many columns, without those of dashes."""
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [row for row in cells if len(row) == width and not row[0].startswith("---")]


def numbers(cell: str) -> list[float]:
    """The number of a cell, and the ends of its interval."""
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", cell)]


@pytest.mark.parametrize("task", TASKS)
def test_the_table_of_a_task_has_the_figures_of_its_evaluation(task: str) -> None:
    heads, *written = rows((RESULTS / f"bundled-{task}.md").read_text(), 14)
    evaluated = {(row[0], row[1]): dict(zip(heads, row, strict=True)) for row in written}
    table = rows(section(task), 10)[1:]
    assert len(table) == 14
    for row in table:
        name = (re.findall(r"`(.*)`", row[0]) or [METHODS[row[0]]])[0]
        budget = {"where2act": "4", "aap-no-tries": "0"}.get(name, row[1])
        for place, head in (COLUMNS | {BEST_SHARE: "sample-success, best share"}).items():
            given, exact = numbers(row[place]), numbers(evaluated[name, budget][head])
            assert given == pytest.approx(exact, abs=0.0005 if head == "BCE" else 0.51), f"{row[0]} {row[1]}: {head}"


def test_the_summary_has_the_figures_of_the_tables() -> None:
    summary = rows(PAGE.partition("\n## Real objects")[0], 8)[1:]
    assert [re.findall(r"\[(.*)\]", row[0])[0] for row in summary] == list(TASKS)
    for task, (_, objects, way, constant, policy, where2act, drawn, repeated) in zip(TASKS, summary, strict=True):
        text = " ".join(section(task).split())
        table = rows(section(task), 10)[1:]
        after_four = {row[0].partition(" (")[0]: row for row in table if row[1] in ("4", "none")}
        assert text.startswith(f"{objects} ")
        assert f"cross entropy of {constant}" in text
        assert policy == after_four[way][2]
        assert float(policy) == min(float(row[2]) for row in table if row[1] == "4"), "the best way"
        assert numbers(where2act) == numbers(after_four["Where2Act"][BEST_SHARE])[:1]
        assert numbers(drawn) == numbers(after_four[way][BEST_SHARE])[:1]
        after = {
            "furthest points": "after furthest points",
            "AIP": "after AIP's interactions",
            "AIP, furthest half": "after AIP's in the furthest half",
        }[way]
        assert re.search(rf"/ {repeated} (?:of the actions )?(?:succeed )?(?:from the start )?{after}", text)
