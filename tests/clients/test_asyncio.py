"""The client for asyncio: the same answers, while other tasks continue."""

from __future__ import annotations

import asyncio
import inspect
from pathlib import Path
from selectors import DefaultSelector

import pytest

from deploy.clients.python.graspd_client import AsyncClient, Client, Decision
from tests.clients.false_daemon import false_daemon, of
from tests.kit.waiting import wait_until

SHORT_S, DEADLINE_S, HOURS_S = 0.05, 0.3, 1e6


def made(folder: Path, *, ask: bool = True) -> AsyncClient:
    return AsyncClient(f"ipc://{folder}/out", ask_endpoint=f"ipc://{folder}/ask" if ask else None)


def test_the_asyncio_client_has_the_clients_calls_and_arguments() -> None:
    for name, call in vars(Client).items():
        if inspect.isfunction(call) and not name.startswith("_"):
            other = inspect.signature(getattr(AsyncClient, name))
            assert inspect.signature(call) == other
    assert inspect.signature(Client) == inspect.signature(AsyncClient)


def test_a_lift_is_allowed_and_reported_once(tmp_path: Path) -> None:
    async def lifts() -> None:
        async with made(tmp_path) as graspd:
            answer = await graspd.may_i_lift(HOURS_S)
            assert answer
            assert (await graspd.verdict()).decision is Decision.STABLE
            assert await graspd.tell(answer.verdict, "slipped", "mug", HOURS_S)
            again = answer
            while again.verdict.reasons != ("outcome-told",):  # on a busy machine one may be old
                again = await graspd.may_i_lift(DEADLINE_S, supervised=True)
                assert not again
            assert graspd.unreported == 0
        assert (await graspd.verdict()).reasons == ("closed",)

    with false_daemon(tmp_path):
        asyncio.run(lifts())


def test_without_a_daemon_asyncio_calls_end_at_their_deadlines(tmp_path: Path) -> None:
    async def asks() -> None:
        async with made(tmp_path) as graspd:
            answer = await graspd.may_i_lift(DEADLINE_S)
            assert (bool(answer), answer.verdict.reasons) == (False, ("no-message",))
            assert answer.waited_s >= DEADLINE_S
            assert await graspd.wait_for_grasp(SHORT_S) is None

    asyncio.run(asks())


@pytest.mark.parametrize("same_computer", [True, False])
def test_the_asyncio_client_waits_without_polling(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, same_computer: bool
) -> None:
    looks: list[float | None] = []
    select = DefaultSelector.select

    def noted(selector: DefaultSelector, timeout: float | None = None) -> object:
        looks.append(timeout)
        return select(selector, timeout)

    async def waits() -> None:
        out = f"ipc://{tmp_path}/out"
        async with AsyncClient(out, same_computer=same_computer) as graspd:
            await graspd.verdict(0.3)
            await graspd.wait_for_grasp(0.3)

    monkeypatch.setattr(DefaultSelector, "select", noted)
    asyncio.run(waits())
    assert len(looks) < 20, "a few for each call, and for what the clocks round off"


def test_other_tasks_run_while_the_asyncio_client_waits(tmp_path: Path) -> None:
    async def waits() -> None:
        async with made(tmp_path, ask=False) as graspd:
            waiting = asyncio.create_task(graspd.wait_for_grasp(60.0))
            for _ in range(20):
                await asyncio.sleep(DEADLINE_S / 100)
                assert not waiting.done()

    with false_daemon(tmp_path, outcome="unknown"):
        asyncio.run(waits())


def test_an_overlapping_call_is_refused_and_a_cancelled_one_ends(tmp_path: Path) -> None:
    async def overlaps(heard: list[bytes]) -> None:
        async with made(tmp_path) as graspd:
            waiting = asyncio.create_task(graspd.may_i_lift(HOURS_S))
            while not heard:
                await asyncio.sleep(SHORT_S)
            with pytest.raises(RuntimeError, match="one call at a time"):
                await graspd.verdict()
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            assert not await graspd.may_i_lift(1.0)  # long enough to connect

    with false_daemon(tmp_path, of("unknown")) as heard:
        asyncio.run(overlaps(heard))
        wait_until(lambda: heard.count(b"not-lifting") == 2)


def test_a_cancelled_call_that_was_turned_away_ends(tmp_path: Path) -> None:
    async def cancels() -> None:
        out = f"ipc://{tmp_path}/out"
        async with AsyncClient(out, ask_endpoint=out) as graspd:
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(graspd.may_i_lift(HOURS_S), DEADLINE_S)
            assert (await graspd.verdict(HOURS_S)).seq is not None

    with false_daemon(tmp_path, outcome="unknown"):
        asyncio.run(cancels())


def test_closing_ends_a_task_that_waits(tmp_path: Path) -> None:
    async def closes() -> None:
        graspd = made(tmp_path)
        waiting = asyncio.create_task(graspd.may_i_lift(HOURS_S))
        await asyncio.sleep(SHORT_S)
        graspd.close()
        answer = await waiting
        assert (bool(answer), answer.verdict.reasons) == (False, ("closed",))
        assert await graspd.wait_for_grasp(HOURS_S) is None

    asyncio.run(closes())
