import errno
from pathlib import Path

import pytest

from heliograph.disk import check_replaceable, remove_leftover_folders, whole_folder


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
    assert [p.name for p in target.iterdir()] == ["new"]


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
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")) == ["out", "out/old"]


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
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["first"]


def test_a_full_disk_names_the_folder(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space left") as caught, whole_folder(tmp_path / "out"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "out")


def test_only_earlier_results_are_replaceable(tmp_path: Path) -> None:
    check_replaceable(tmp_path / "new", "mark")
    check_replaceable(tmp_path, "mark")
    (tmp_path / "other").touch()
    with pytest.raises(ValueError, match="got other files"):
        check_replaceable(tmp_path, "mark")
    (tmp_path / "mark").touch()
    check_replaceable(tmp_path, "mark")
