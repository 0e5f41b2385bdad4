"""Claims: one process gets a recording, keeps it while it lives, and loses it when it does not."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from jaxfilters.trackers.batch import claims
from jaxfilters.trackers.batch.claims import Claims


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def elsewhere(monkeypatch):
    """Makes claims look as if they were of a machine whose processes cannot be asked for."""
    monkeypatch.setattr(claims, "machine", iter(map(str, range(1000))).__next__)


def state_of(watcher, name):
    number = watcher.numbers().get(name)
    return number, watcher.is_free(name, number)


def test_one_of_many_gets_a_recording(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        taken = list(pool.map(lambda _: Claims(tmp_path, 60.0).take("a.b", None), range(50)))
    assert [claim for claim in taken if claim] == [claims.Claim("a.b", 0, 0)]
    assert state_of(Claims(tmp_path, 60.0), "a.b") == (0, False)


@pytest.mark.usefixtures("elsewhere")
def test_a_claim_without_signs_of_life_is_taken_over_once_and_its_holder_learns_of_it(tmp_path, clock):
    holder, watcher, other = (Claims(tmp_path, 60.0, clock) for _ in range(3))
    claim = holder.take("a", None)
    os.utime(tmp_path / "a.0", (1, 1))  # the clock of the file server does not matter
    assert state_of(watcher, "a") == state_of(other, "a") == (0, False)
    clock.now = 59.0
    assert holder.beat([claim]) == []
    clock.now = 61.0
    assert state_of(watcher, "a") == state_of(other, "a") == (0, False)
    clock.now = 122.0
    assert state_of(watcher, "a") == state_of(other, "a") == (0, True)
    assert watcher.take("a", 0) == claims.Claim("a", 1, 1)
    assert other.take("a", 0) is None
    assert state_of(other, "a") == (1, False)
    assert holder.beat([claim]) == [claim]


def test_what_a_dead_process_of_this_machine_held_is_free_at_once(tmp_path):
    holder = (
        "import sys, pathlib; from jaxfilters.trackers.batch.claims import Claims; "
        "Claims(pathlib.Path(sys.argv[1]), 1e6).take('a', None)"
    )
    subprocess.run([sys.executable, "-c", holder, str(tmp_path)], check=True)
    assert state_of(Claims(tmp_path, 1e6), "a") == (0, True)


def test_attempts_that_a_person_ended_do_not_count(tmp_path):
    mine = Claims(tmp_path, 60.0)
    for number, counts in enumerate((False, True, False)):
        mine.release(mine.take("a", number - 1 if number else None), counts=counts)
        assert state_of(mine, "a") == (number, True)
    assert mine.take("a", 2).attempts == 1
    mine.forget(["a"])
    assert state_of(mine, "a") == (None, True)
