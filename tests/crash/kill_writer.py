"""The writer, killed at random instants: `python -m tests.crash.kill_writer FOLDER KILLS SEED`.

Each life is a fork of this process that recovers the mission and flies on until it is killed, in
recovery as well as in flight. Whatever it told anybody is held against the disk after every tenth
life, by recovery, hashes and chain.
"""

from __future__ import annotations

import json
import os
import random
import select
import signal
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from daemon.mission.layout import Mission
from tests.crash.flight import live
from tests.crash.judging import Told, judge
from tests.daemon.small_camera import new_mission

JUDGED_EVERY = 10
LIVES_OF_A_MISSION = 50
LIFE_LIMIT_S = 30.0
SHARE_KILLED_EARLY = 0.3
EARLY_S = 0.03
"""Of a life that is killed while it recovers, or soon after; recovery takes some 10 ms."""


@dataclass
class Figures:
    """What was told, and what was found."""

    kills: int = 0
    killed_in_recovery: int = 0
    missions: int = 0
    stored: int = 0
    sealed: int = 0
    exposures: int = 0
    set_aside: int = 0
    wrong: list[str] = field(default_factory=list)


def kill(folder: Path, kills: int, seed: int) -> Figures:
    """Kill so often; findings are in `wrong`."""
    dice = random.Random(seed)
    figures = Figures()
    while figures.kills < kills:
        figures.missions += 1
        root = folder / str(figures.missions)
        mission = new_mission(root)
        told = Told(mission=mission.id)
        lives = min(LIVES_OF_A_MISSION, kills - figures.kills)
        for life in range(1, lives + 1):
            figures.killed_in_recovery += not _live_and_die(mission, told, dice)
            figures.kills += 1
            if life % JUDGED_EVERY == 0 or life == lives:
                try:
                    outcome = judge(root, told, flies_on=False)
                except AssertionError as error:
                    figures.wrong.append(f"{mission.path}, life {life}: {error}")
                    break
        else:
            figures.exposures += outcome.exposures
            figures.set_aside += outcome.discarded
        figures.stored += len(told.stored)
        figures.sealed += len(told.sealed)
    return figures


def _live_and_die(mission: Mission, told: Told, dice: random.Random) -> bool:
    """One life; whether it came out of recovery before it was killed."""
    heard, says = os.pipe()
    child = os.fork()
    if not child:
        os.close(heard)
        with mission.held():
            live(mission, says, None, lands=False, keeps="handed over")
    os.close(says)
    try:
        lines = _hear(heard, dice)
        # Between two words anything is under way: files, folder, rename, commit, record.
        _spin(dice.uniform(0.0, 0.004))
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    lines += _rest(heard)
    os.close(heard)
    for line in lines.decode().splitlines():
        told.hear(line)
    return b"flying 0\n" in lines


def _hear(heard: int, dice: random.Random) -> bytes:
    """What the life says until it has said enough or a moment has passed, both by chance."""
    words = b""
    is_early = dice.random() < SHARE_KILLED_EARLY
    wanted = 0 if is_early else dice.randrange(1, 16)
    limit_s = dice.uniform(0.0, EARLY_S) if is_early else LIFE_LIMIT_S
    end_s = time.monotonic() + limit_s
    while is_early or words.partition(b"flying 0\n")[2].count(b"\n") < wanted:
        left_s = end_s - time.monotonic()
        readable = select.select([heard], [], [], max(0.0, left_s))[0]
        if not readable:
            assert is_early, "a life hangs"
            break
        word = os.read(heard, 65536)
        assert word, "a life ended by itself"
        words += word
    return words


def _rest(heard: int) -> bytes:
    words = b""
    while word := os.read(heard, 65536):
        words += word
    return words


def _spin(seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        pass


def main() -> None:
    folder, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    begun_s = time.monotonic()
    figures = kill(folder, kills, seed)
    print(json.dumps(asdict(figures) | {"seconds": round(time.monotonic() - begun_s, 1)}))


if __name__ == "__main__":
    main()
