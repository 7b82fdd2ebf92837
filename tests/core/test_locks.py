"""Locks of folders, and the temporary files that dead processes left in them."""

import os
import threading
import time

import pytest
from support.processes import holder

from climatenerf.core import storage
from climatenerf.core.errors import UserError
from climatenerf.core.locks import LOCK, only_writer


def test_a_second_writer_is_refused_until_the_first_one_exits(tmp_path):
    folder = tmp_path / "run"
    with holder(folder) as process:
        refused = pytest.raises(UserError, match=f"another process is writing into {folder}; wait")
        with refused, only_writer(folder):
            pytest.fail("two writers")
        assert [p for p in folder.iterdir() if storage.is_temporary(p.name)], (
            "a temporary file of the first writer"
        )
        process.kill()
        process.join()
        with only_writer(folder):
            assert [p.name for p in folder.iterdir()] == [LOCK], (
                "files of the dead process are removed"
            )


def test_a_lock_is_reentrant_within_one_thread_only(tmp_path):
    refused = []

    def other():
        try:
            with only_writer(tmp_path):
                pass
        except UserError as error:
            refused.append(str(error))

    with only_writer(tmp_path):
        with only_writer(tmp_path):
            pass
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(refused) == 1
    other()
    assert len(refused) == 1


@pytest.mark.parametrize("filled", [False, True])
def test_a_new_folder_is_removed_if_nothing_was_written(tmp_path, filled):
    with pytest.raises(UserError), only_writer(tmp_path / "new"):
        if filled:
            (tmp_path / "new" / "file").write_text("")
        raise UserError("wrong input")
    assert (tmp_path / "new").exists() == filled
    (tmp_path / "old").mkdir()
    with only_writer(tmp_path / "old"):
        pass
    assert (tmp_path / "old").exists(), "the user made it"


def test_only_files_of_dead_processes_are_removed(tmp_path):
    day = storage.ABANDONED_AFTER
    alive = storage.owned_name()
    host, number, process, rest = alive.split("-")
    names = {
        f".{alive}.tmp.png": False,
        f".{host}-{number}-ffffff-{rest}.tmp.png": True,  # an earlier process of our number
        f".{host}-{os.getppid()}-{process}-{rest}.tmp": False,
        f".{host}-{2**22 + 5}-{process}-{rest}.tmp.json": True,
        f".{host}-{10**30}-{process}-{rest}.tmp.json": True,
        f".00000000-1-{process}-{rest}.tmp.npz": False,  # of another host, and new
        ".0123456789ab.tmp.mp4": False,  # of an earlier version, and new
        "mine.tmp.png": False,
        ".mine.tmp": False,
    }
    old = {f".00000000-1-{process}-{rest}.tmp.exr": True, ".0123456789ab.tmp.safetensors": True}
    for folder in (tmp_path, tmp_path / "sub" / "deep", tmp_path / "other"):
        folder.mkdir(parents=True, exist_ok=True)
        for name in (*names, *old):
            (folder / name).write_bytes(b"")
        for name in old:
            os.utime(folder / name, (time.time() - 2 * day,) * 2)
    storage.remove_abandoned(tmp_path, ["sub", "absent"])
    kept = {name for name, removed in (names | old).items() if not removed}
    for folder in (tmp_path, tmp_path / "sub" / "deep"):
        assert {p.name for p in folder.iterdir() if p.is_file()} == kept
    assert len(list((tmp_path / "other").iterdir())) == len(names | old)


def test_links_to_other_folders_are_not_cleared(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "run").mkdir()
    host, _, process, rest = storage.owned_name().split("-")
    foreign = tmp_path / "mine" / f".{host}-{2**22 + 5}-{process}-{rest}.tmp.png"
    foreign.write_bytes(b"")
    (tmp_path / "run" / "labels").symlink_to(tmp_path / "mine")
    storage.remove_abandoned(tmp_path / "run", ["labels"])
    assert foreign.exists()
