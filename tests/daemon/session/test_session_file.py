"""The session's file: whole whenever it is cut off, damage found and put aside."""

from __future__ import annotations

import itertools
import os
import random
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.daemon.session.file import (
    SessionFile,
    SessionFileError,
    kept_now,
    load,
)
from graspd.daemon.trust.lift_book import LIFTS_MAX
from graspd.daemon.trust.trust import decode
from graspd.models.session_statistics import SessionState
from tests.daemon.session.learning import (
    FINGERS,
    calibration,
    grasps_of,
    judge,
    observe,
    tell,
    trust,
)

STEPS = ("open", "fchmod", "fsync", "replace")
"""Functions of `os` by which a file is written; a kill comes before or after a call of one."""
CALLS = 6
"""Of these in a save: open, fchmod and fsync of the part, the replacement, the folder's two."""


class Killed(BaseException):
    """Ends a save as a kill does: nothing is tidied up."""


@contextmanager
def killed(call: int, *, after: bool) -> Iterator[None]:
    """Kill what runs inside before or after so many calls."""
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
    """Statistics that can be told from all others."""
    return SessionState(float(grasps), grasps, (float(grasps),), (1.0,))


def save(file: SessionFile, grasps: int) -> None:
    file.save(kept_now(state(grasps), FINGERS, {}))


def test_a_kill_at_any_step_of_a_save_leaves_the_former_or_the_new_one(tmp_path: Path) -> None:
    found = set()
    for call, after, before in itertools.product(range(CALLS), (False, True), (1, 2)):
        path = tmp_path / f"{call}{after}{before}.json"
        with SessionFile(path) as file:
            for grasps in range(1, before + 1):
                save(file, grasps)
            with pytest.raises(Killed), killed(call, after=after):
                save(file, before + 1)
        with SessionFile(path) as file:  # the next start
            kept = grasps_of(file.load())
            found.add(kept - before)
            assert kept in (before, before + 1)
            save(file, 9)
            assert grasps_of(file.load()) == 9
            names = sorted(each.name for each in tmp_path.glob(f"{path.name}*"))
            assert names == [path.name, f"{path.name}.lock"]
    assert found == {0, 1}
    with SessionFile(path) as file:
        file.load()
        with killed(CALLS, after=False):
            save(file, 1)  # there are no more calls


Plan = list[tuple[int | None, bool]]
"""Of each life of a daemon: at which call its last save is killed, before or after."""
PLANS = st.lists(
    st.tuples(st.none() | st.integers(0, CALLS - 1), st.booleans()), min_size=1, max_size=8
)


@settings(max_examples=60)
@given(PLANS)
def test_whenever_it_is_killed_nothing_that_was_kept_is_lost(
    tmp_path_factory: pytest.TempPathFactory, plan: Plan
) -> None:
    path = tmp_path_factory.mktemp("session") / "right.json"
    written, kept = 0, 0
    for call, after in plan:
        with SessionFile(path) as file:
            assert kept <= grasps_of(file.load()) <= written
            for _ in range(2):
                written += 1
                save(file, written)
            kept = written
            with suppress(Killed), killed(CALLS if call is None else call, after=after):
                written += 1
                save(file, written)
                kept = written
    assert kept <= grasps_of(load(path)) <= written


def learned(path: Path) -> bytes:
    """A file as it is after a day, with grasps whose outcome is still out."""
    session, part = calibration(), trust()
    observe(session, 30)
    for grasp in range(40):
        judge(part, grasp)
        if grasp % 4:
            tell(part, grasp)
    with SessionFile(path) as file:
        file.save(kept_now(session.state(), FINGERS, {"ff": "A"}, part.state()))
    return path.read_bytes()


def damage(data: bytes, choose: random.Random) -> bytes:
    """Flip bits, cut, overwrite, repeat or leave out."""
    place, length = choose.randrange(len(data)), choose.choice((1, 8, 512, 4096))
    kind = choose.randrange(6)
    if kind <= 1:
        flipped = bytearray(data)
        for _ in range(choose.choice((1, 1, 2, 50))):
            flipped[choose.randrange(len(data))] ^= 1 << choose.randrange(8)
        return bytes(flipped)
    return (
        data[:place],
        data[:place] + bytes(length) + data[place + length :],
        data[:place] + data[place : place + length] + data[place:],
        data[:place] + data[place + length :],
    )[kind - 2]


def test_a_thousand_damaged_files_never_become_a_state_that_was_not_written(tmp_path: Path) -> None:
    path = tmp_path / "right.json"
    data = learned(path)
    written, choose, refused = load(path), random.Random(16), 0
    for _ in range(1000):
        damaged = damage(data, choose)
        path.write_bytes(damaged)
        try:
            assert load(path) == written, damaged
        except SessionFileError:
            refused += 1
        else:
            assert damaged.strip() == data.strip()
    assert refused > 990


@pytest.mark.parametrize("spoil", ["cut", "flip", "empty", "nested"])
def test_what_cannot_be_read_is_put_aside_never_replaced(tmp_path: Path, spoil: str) -> None:
    path = tmp_path / "right.json"
    with SessionFile(path) as file:
        save(file, 2)
    data = path.read_bytes()
    spoiled = {
        "cut": data[:-9],
        "flip": data.replace(b'"grasps":2', b'"grasps":5'),
        "empty": b"",
        "nested": b'{"version":2,"sha256":"a","kept":' + b"[" * 100_000,
    }[spoil]
    path.write_bytes(spoiled)
    with SessionFile(path) as file:
        with pytest.raises(SessionFileError, match=r"right\.json: not a session"):
            file.load()
        for grasps in (3, 4):
            save(file, grasps)
        (aside,) = tmp_path.glob("right.json.aside-?")
        assert (aside.read_bytes(), grasps_of(file.load())) == (spoiled, 4)
        assert file.remove()
        assert not file.remove()
        assert file.load() is None
    assert [each.name for each in tmp_path.iterdir()] == ["right.json.lock"]


def test_what_was_put_aside_is_at_most_sixteen_files(tmp_path: Path) -> None:
    path = tmp_path / "right.json"
    for _ in range(60):
        path.write_bytes(b"?")
        with SessionFile(path) as file:
            save(file, 1)
    assert len(list(tmp_path.glob("right.json.aside-*"))) == 16


def test_what_is_learned_fits_into_the_file_with_every_outcome_still_out(tmp_path: Path) -> None:
    part = trust(inputs=5 * 26)
    for grasp in range(LIFTS_MAX + 1):
        judge(part, grasp)
    with SessionFile(tmp_path / "right.json") as file:
        file.save(kept_now(calibration().state(), FINGERS, {}, part.state()))
        kept = file.load()
    assert kept is not None
    assert kept.trust is not None
    assert decode(kept.trust) == part.state()
    assert (tmp_path / "right.json").stat().st_size < 1 << 20
