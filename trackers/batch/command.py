"""`jaxfilters batch`: claims recordings, starts a process for each, and takes over what other processes left."""

import argparse
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from jaxfilters.trackers.app.output_folder import check_free, reason
from jaxfilters.trackers.app.progress import note
from jaxfilters.trackers.batch.claims import Claim, Claims
from jaxfilters.trackers.batch.manifest import Entry, read_manifest
from jaxfilters.trackers.batch.over_ray import run_on_cluster
from jaxfilters.trackers.batch.report import DONE, FAILED, Result, Results, aligned, error_in, report_of
from jaxfilters.trackers.io.errors import InputError, OutputError

CHILD = (sys.executable, "-P", "-m", "jaxfilters.trackers.batch.child")
POLL_S, LOOK_S = 0.1, 1.0
"""Seconds between checks whether a process has ended, and between checks of the claims of other machines."""
MOST_ATTEMPTS = 3
"""Of a recording whose process is killed or crashes each time: for want of memory, for example."""
_GRACE_S = 60.0
"""For processes that are asked to end, to keep what they have."""


class Running(NamedTuple):
    """A recording that a process of this command tracks."""

    entry: Entry
    claim: Claim
    process: subprocess.Popen[bytes]
    began: float


def batch(options: argparse.Namespace) -> str:
    """Track the recordings of a manifest together with every other process that runs the same command.

    Returns:
        A table of the recordings.

    Raises:
        InputError: The manifest or what lies in the folder of the results cannot be used, or a recording has failed.
        OutputError: The folder of the results cannot be written.
        KeyboardInterrupt: With what is finished as its text.
    """
    entries = read_manifest(options.manifest)
    try:
        run = Batch(entries, options)
        return _finish(run, run.work if options.ray is None else partial(run_on_cluster, options))
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"cannot write into {options.out}: {reason(error)}.") from None


def _finish(run: "Batch", work: Callable[[], None]) -> str:
    try:
        work()
    except KeyboardInterrupt as interrupt:
        results = run.results.write_report()
        count = sum(result.status == DONE for result in results.values())
        raise type(interrupt)(f"{count} of {len(results)} recordings are done; the same command continues") from None
    results = run.results.write_report()
    table = f"{aligned(results)}\nreport in {run.out}: report.json, report.csv"
    if failed := [name for name, result in results.items() if result.status == FAILED]:
        note(table)
        first = f"{failed[0]}: {results[failed[0]].error}"
        raise InputError(f"{len(failed)} of {len(results)} recordings failed, first {first}")
    return table


class Batch:
    """What one command does with the recordings of a manifest."""

    def __init__(self, entries: list[Entry], options: argparse.Namespace):
        """Nothing is started yet; arguments as of `batch`."""
        self.out: Path = options.out.resolve()
        self._entries, self._options = entries, options
        self._base = options.manifest.resolve().parent
        self.results = Results(self.out, entries)
        for folder in ("claims", "logs"):
            (self.out / ".batch" / folder).mkdir(exist_ok=True)
        self._claims = Claims(self.out / ".batch" / "claims", options.stale)
        if options.retry:
            failed = [name for name, result in self.results.finished().items() if result.status == FAILED]
            # As long as there is a result, no process claims the recording.
            self._claims.forget(failed)
            self.results.forget(failed)
        self._running: list[Running] = []
        self._looked = -LOOK_S

    def work(self) -> None:
        """Track what no other process tracks, until all recordings have a result, or, without waiting, none is free."""
        try:
            while True:
                self._collect()
                self._beat()
                if not self._start() and not self._running:
                    return
                time.sleep(POLL_S)
        finally:
            self._stop()

    def _start(self) -> bool:
        """Start as many as there is room for; whether there is more to do or to wait for."""
        if len(self._running) >= self._options.processes or time.monotonic() - self._looked < LOOK_S:
            return True
        mine = {one.entry.name for one in self._running}
        finished = self.results.finished()
        waiting = [entry for entry in self._entries if entry.name not in finished and entry.name not in mine]
        numbers = self._claims.numbers() if waiting else {}
        for entry in waiting:
            if len(self._running) >= self._options.processes:
                return True
            self._start_if_free(entry, numbers.get(entry.name))
        self._looked = time.monotonic()
        return bool(waiting) and self._options.wait

    def _start_if_free(self, entry: Entry, number: int | None) -> None:
        if not self._claims.is_free(entry.name, number):
            return
        try:
            check_free(self.out / entry.name)
        except OutputError:
            return  # The process of a command that was killed has not ended yet.
        claim = self._claims.take(entry.name, number)
        if claim is None or entry.name in self.results.finished():
            return
        if claim.attempts >= MOST_ATTEMPTS:
            error = f"its process ended {claim.attempts} times without a result; see {self._log(entry)}"
            self._keep(entry, Result(FAILED, attempts=claim.attempts, machine=socket.gethostname(), error=error))
            return
        command = [*CHILD, *entry.arguments(self._folder(entry))]
        with self._log(entry).open("wb") as log:
            # A session of its own: Ctrl-C reaches this process alone, which then asks the others to end.
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=self._base, start_new_session=True
            )
        self._running.append(Running(entry, claim, process, time.monotonic()))

    def _collect(self, *, stopping: bool = False) -> None:
        """Keep the results of processes that have ended."""
        for one in [one for one in self._running if one.process.poll() is not None]:
            self._running.remove(one)
            one.process.communicate()  # closes its standard input
            code, report = one.process.returncode, report_of(self._folder(one.entry))
            ended_early = code < 0 or code in (128 + signal.SIGINT, 128 + signal.SIGTERM)
            if ended_early:
                self._claims.release(one.claim, counts=not stopping)
                if not stopping:
                    note(f"{one.entry.name}: its process was ended ({_in_words(code)})")
                continue
            result = Result(
                FAILED if code else DONE,
                round(time.monotonic() - one.began, 2),
                None if code else report.get("frames"),
                None if code else report.get("frames_per_second"),
                one.claim.attempts + 1,
                socket.gethostname(),
                error_in(self._log(one.entry)) if code else "",
            )
            self._keep(one.entry, result)

    def _keep(self, entry: Entry, result: Result) -> None:
        self.results.add(entry.name, result)
        what = f"{result.frames} frames in {result.seconds:.0f} s" if result.status == DONE else result.error
        note(f"[{len(self.results.finished())}/{len(self._entries)}] {entry.name}: {result.status}, {what}")

    def _beat(self) -> None:
        """Give signs of life; end processes whose recordings others took over because this machine was thought dead."""
        lost = self._claims.beat([one.claim for one in self._running])
        for one in [one for one in self._running if one.claim in lost]:
            note(f"{one.entry.name}: taken over by another process")
            one.process.kill()
            one.process.communicate()
            self._running.remove(one)

    def _stop(self) -> None:
        """Ask the processes to end, and let others continue what they have kept."""
        for one in self._running:
            one.process.terminate()
        deadline = time.monotonic() + _GRACE_S
        while any(one.process.poll() is None for one in self._running) and time.monotonic() < deadline:
            self._beat()
            time.sleep(POLL_S)
        for one in self._running:
            one.process.kill()
            one.process.wait()
        self._collect(stopping=True)

    def _folder(self, entry: Entry) -> Path:
        return self.out / entry.name

    def _log(self, entry: Entry) -> Path:
        return self.out / ".batch" / "logs" / f"{entry.name}.txt"


def _in_words(code: int) -> str:
    return signal.Signals(-code).name if code < 0 else "terminated"
