import errno
from pathlib import Path

import pytest

from heliograph.disk import check_only_results, check_replaceable, remove_leftover_folders, whole_folder

LISTING = ".written.json"


def test_new_folder_appears_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "x" / "out"
    with whole_folder(target) as folder:
        (folder / "a").write_text("1")
        assert not target.exists()
    assert (target / "a").read_text() == "1"
    assert [p.name for p in target.parent.iterdir()] == ["out"]


def test_old_results_are_replaced_as_a_whole(tmp_path: Path) -> None:
    target = tmp_path / "out"
    for name in ("old", "new"):
        with whole_folder(target) as folder:
            (folder / name).touch()
    assert sorted(p.name for p in target.iterdir()) == [LISTING, "new"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_error_leaves_all_as_it_was(tmp_path: Path, error: type[BaseException]) -> None:
    with whole_folder(tmp_path / "out") as folder:
        (folder / "old").touch()

    def fail_half_way(target: Path) -> None:
        with whole_folder(target) as folder:
            (folder / "half").touch()
            raise error

    for target in (tmp_path / "out", tmp_path / "deep" / "er"):
        with pytest.raises(error):
            fail_half_way(target)
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")) == [
        "out",
        f"out/{LISTING}",
        "out/old",
    ]


def test_what_a_killed_process_left_is_cleared_and_what_it_put_aside_put_back(tmp_path: Path) -> None:
    target, left = tmp_path / "out", tmp_path / ".out-killed_1"
    for part in ("new", "old"):
        (left / part).mkdir(parents=True)
        (left / part / part).touch()
    (tmp_path / ".out-of_mine").mkdir()  # not named as ours are
    remove_leftover_folders(target)
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")) == [".out-of_mine", "out", "out/old"]


def test_what_another_process_works_in_stays(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "out") as folder:
        with whole_folder(tmp_path / "out") as other:
            (other / "second").touch()
        (folder / "first").touch()
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [LISTING, "first"]


def test_a_full_disk_names_the_folder(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space left") as caught, whole_folder(tmp_path / "out"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "out")


def test_only_a_folder_with_the_mark_is_gone_on_with(tmp_path: Path) -> None:
    check_only_results(tmp_path / "new", "mark")
    check_only_results(tmp_path, "mark")
    (tmp_path / "other").touch()
    with pytest.raises(ValueError, match="got other files"):
        check_only_results(tmp_path, "mark")
    (tmp_path / "mark").touch()
    check_only_results(tmp_path, "mark")


def write_results_in(target: Path) -> None:
    with whole_folder(target) as folder:
        (folder / "plant").mkdir()
        (folder / "plant" / "page").write_text("ours")
        (folder / "summary.json").write_text("{}")


def test_earlier_results_are_replaceable_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "out"
    check_replaceable(target)
    write_results_in(target)
    (target / ".lock").touch()
    (target / "plant" / ".DS_Store").touch()  # of a file manager
    check_replaceable(target)
    for added in ("notes.txt", "plant/notes.txt"):
        (target / added).touch()
        with pytest.raises(ValueError, match=f"got {added}, which would be lost"):
            check_replaceable(target)
        (target / added).unlink()
    (target / "plant" / "page").write_text("mine")  # as long as it was
    with pytest.raises(ValueError, match="got plant/page, which"):
        check_replaceable(target)


def test_a_folder_of_the_user_is_not_taken_for_results_by_the_name_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text("{}")
    (tmp_path / "thesis.tex").touch()
    (tmp_path / LISTING).write_text("no list of ours")
    with pytest.raises(ValueError, match=r"got \.written\.json and 2 others"):
        check_replaceable(tmp_path)


def test_what_the_user_put_into_a_folder_meanwhile_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "out"
    write_results_in(target)
    with pytest.warns(UserWarning, match="had files that were not written"), whole_folder(target) as folder:
        (folder / "summary.json").touch()
        (target / "notes.txt").write_text("mine")
    (kept,) = tmp_path.glob("out-kept-*")
    assert (kept / "notes.txt").read_text() == "mine"
    assert sorted(path.name for path in target.iterdir()) == [LISTING, "summary.json"]
