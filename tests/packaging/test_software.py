"""The commit that documents name is that of the checkout, however git keeps it."""

from pathlib import Path

import pytest

from shared.software import git_commit

COMMIT, OTHER = "1" * 40, "2" * 40
BRANCH = "refs/heads/a/branch"
PACKED = f"# pack-refs with: peeled\n{OTHER} refs/heads/a\n{COMMIT} {BRANCH}\n{OTHER} refs/tags/v1\n^{OTHER}\n"


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


@pytest.mark.parametrize(
    "files",
    [
        {"HEAD": COMMIT},
        {"HEAD": f"ref: {BRANCH}\n", BRANCH: f"{COMMIT}\n", "packed-refs": f"{OTHER} {BRANCH}\n"},
        {"HEAD": f"ref: {BRANCH}\n", "packed-refs": PACKED},
    ],
    ids=["detached", "a branch", "a packed branch"],
)
@pytest.mark.parametrize("relative", [False, True], ids=["whole path", "relative path"])
def test_git_commit_of_a_checkout_and_of_another_worktree_is_found(
    tmp_path: Path, files: dict[str, str], relative: bool
) -> None:
    write(tmp_path / "main" / ".git", files)
    assert git_commit(tmp_path / "main") == COMMIT
    own = tmp_path / "main" / ".git" / "worktrees" / "other"
    write(own, {"HEAD": files["HEAD"], "commondir": "../..\n"})
    write(tmp_path / "main" / ".git", {"HEAD": f"{OTHER}\n"})
    write(tmp_path / "other", {".git": f"gitdir: {'../main/.git/worktrees/other' if relative else own}\n"})
    assert git_commit(tmp_path / "other") == COMMIT


@pytest.mark.parametrize(
    "files",
    [
        {},
        {".git": "gitdir: ../removed\n"},
        {".git/HEAD": f"ref: {BRANCH}\n"},
        {".git/HEAD": f"ref: {BRANCH}\n", ".git/packed-refs": f"{COMMIT} {BRANCH}-2\n\n"},
    ],
    ids=["no checkout", "a removed repository", "no commit yet", "another branch alone"],
)
def test_git_commit_is_empty_where_it_is_not_known(tmp_path: Path, files: dict[str, str]) -> None:
    write(tmp_path, files)
    assert git_commit(tmp_path) == ""
