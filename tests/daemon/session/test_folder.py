"""The folder of sessions: whole after a kill at any time, and damage is detected."""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from graspd.daemon.session.file import KeptSession, SessionFileError, load
from graspd.daemon.session.folder import SessionFolder
from graspd.daemon.trust.trust import Trust
from graspd.models.session_statistics import SessionState
from graspd.models.trust.risk import RiskLimits
from tests.daemon.session.learning import FINGERS, INPUTS, judge, kept_in, sealed, tell, trust

STEPS = ("open", "chmod", "fsync", "replace", "unlink")
"""Functions of `os` by which a file is written; a kill comes before or after a call of one."""
CALLS = 6
"""Number of calls of `STEPS` in a save: three for the new file, its renaming, two to sync."""
CALLS_OF_TWO = 2 * CALLS + 1
"""Number of calls of `STEPS` in a save of two sessions that also removes the former file."""


class Killed(BaseException):
    """Ends a save as a kill does: nothing is tidied up."""


@contextmanager
def killed(call: int, *, after: bool) -> Iterator[None]:
    """Raise `Killed` in the block, before or after its call number `call` (from 0) of `STEPS`."""
    left = itertools.count(-call)

    def deadly(real: Callable[..., object]) -> Callable[..., object]:
        def run(*arguments: object) -> object:
            dies = next(left) == 0
            if dies and not after:
                raise Killed
            result = real(*arguments)
            if dies:
                if isinstance(result, int):
                    os.close(result)
                raise Killed
            return result

        return run

    with ExitStack() as stack:
        for name in STEPS:
            stack.enter_context(mock.patch.object(os, name, deadly(getattr(os, name))))
        yield


def state(grasps: int) -> SessionState:
    """Return statistics of this number of grasps; other numbers give other means."""
    return SessionState(float(grasps), grasps, (float(grasps),), (1.0,))


def save(folder: SessionFolder, grasps: int) -> None:
    folder.save([KeptSession(state(grasps), FINGERS, {})])


def kept_grasps(path: Path) -> list[int]:
    return [each.grasps for each in kept_in(path)]


def test_a_kill_at_any_step_loses_no_session(tmp_path: Path) -> None:
    """The save that is killed writes two sessions, as when sensors are exchanged after a start."""
    found = set()
    for call, after in itertools.product(range(CALLS_OF_TWO + 1), (False, True)):
        path = tmp_path / f"{call}{after}"
        with SessionFolder(path) as folder:
            save(folder, 1)
            save(folder, 2)
        with SessionFolder(path) as folder:
            folder.load()
            sessions = [KeptSession(state(10 + n), FINGERS, {"ff": str(n)}) for n in (4, 3)]
            with suppress(Killed), killed(call, after=after):
                folder.save(sessions)
                assert call == CALLS_OF_TWO  # there are no more calls
        found.add(tuple(kept_grasps(path)))
        with SessionFolder(path) as folder:
            folder.load()
            save(folder, 9)
        assert kept_grasps(path) == [9]
        assert len(list(path.iterdir())) == 2
    assert found == {(2,), (13, 2), (14, 13, 2), (14, 13)}


def test_starts_without_a_grasp_evict_no_session(tmp_path: Path) -> None:
    taught = [KeptSession(state(each), FINGERS, {}) for each in (5, 4, 3, 2, 1)]
    with SessionFolder(tmp_path) as folder:
        folder.save(taught)
        for serial in "AB":
            others = [each for each in folder.load().values() if isinstance(each, KeptSession)]
            folder.save([KeptSession(None, FINGERS, {"ff": serial}), *others])
            assert kept_grasps(tmp_path) == [0, 5, 4, 3, 2, 1]
        folder.save([KeptSession(state(6), FINGERS, {}), *taught])
    assert kept_grasps(tmp_path) == [6, 5, 4, 3, 2]


def test_a_session_with_only_risk_counts_is_not_empty() -> None:
    """Without learning an outcome changes only the counts of the risk."""
    part = Trust("model", INPUTS, RiskLimits(0.1), learns=False)
    assert KeptSession(None, FINGERS, {}, part.state()).is_empty
    judge(part, 1)
    tell(part, 1)
    assert part.learner.outcomes == 0
    assert not KeptSession(None, FINGERS, {}, part.state()).is_empty


@given(st.integers(0, 1 << 20), st.integers(0, 255), st.sampled_from(("byte", "cut", "insert")))
@settings(max_examples=300, deadline=None)
def test_a_file_damaged_at_any_place_is_refused(place: int, value: int, kind: str) -> None:
    with TemporaryDirectory() as name:
        with SessionFolder(Path(name)) as folder:
            folder.save([KeptSession(state(2), FINGERS, {"ff": "A"}, trust().state())])
        path = Path(name) / "1.session"
        data = path.read_bytes()
        place %= len(data)
        added = {"byte": bytes([value]), "cut": b"", "insert": bytes([value, data[place]])}[kind]
        after = b"" if kind == "cut" else data[place + 1 :]
        damaged = data[:place] + added + after
        path.write_bytes(damaged)
        if damaged != data:
            with pytest.raises(SessionFileError):
                load(path)


@pytest.mark.parametrize(
    "spoiled",
    [
        sealed(b"\x91" * 100_000),
        sealed(bytes(16 << 20)),
        sealed(msgspec.msgpack.encode({"version": 2})),
        sealed(msgspec.msgpack.encode({"version": 4})),
        sealed(msgspec.msgpack.encode({"version": 3, "grasps": 1})),
        sealed(
            msgspec.msgpack.encode(
                KeptSession(None, FINGERS, {}, replace(trust().state(), version=1))
            )
        ),
    ],
    ids=["nested", "huge", "former", "newer", "no session", "other learning"],
)
def test_wrong_content_with_right_checksum_is_of_another_version(
    tmp_path: Path, spoiled: bytes
) -> None:
    path = tmp_path / "1.session"
    path.write_bytes(spoiled)
    with pytest.raises(SessionFileError, match="of another version of graspd"):
        load(path)


def test_only_the_newest_sixteen_unreadable_files_are_kept(tmp_path: Path) -> None:
    for number in range(1, 41):
        (tmp_path / f"{number}.session").write_bytes(b"?")
    with SessionFolder(tmp_path) as folder:
        folder.load()
        save(folder, 1)
    left = {int(path.stem) for path in tmp_path.glob("*.session")}
    assert left == {*range(25, 41), 41}


def test_a_file_in_place_of_the_folder_is_refused_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "right"
    path.write_bytes(b"?")
    folder = SessionFolder(path)
    for use in (folder.load, lambda: save(folder, 1), folder.remove):
        with pytest.raises(SessionFileError, match=r"right: cannot (keep|read) the session"):
            use()
    assert path.read_bytes() == b"?"


def test_a_disk_without_locks_is_not_reported_as_in_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(SessionFileError, match="cannot keep the session: No locks available"):
        SessionFolder(tmp_path).lock()


def test_files_with_other_names_are_let_alone(tmp_path: Path) -> None:
    names = {f"{stem}.session" for stem in ("0", "007", "٣", "9" * 10)}
    for name in names:
        (tmp_path / name).write_bytes(b"?")
    with SessionFolder(tmp_path) as folder:
        assert folder.load() == {}
        save(folder, 1)
    assert {path.name for path in tmp_path.iterdir()} == {*names, "lock", "1.session"}
