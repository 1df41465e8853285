"""Long work as a list of ordinary commands: what is done is skipped, and what was killed goes on by its own means."""

import csv
import fcntl
import math
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path

from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, read_json, write_json

FOLDER = "stages"
"""Where under the work's folder records and logs are."""
HEARTBEAT = 10.0
"""Seconds after which a running stage's time is noted anew, and shown on a terminal."""
PROGRAM = (sys.executable, "-m", "nerfgrasp")
"""This program, whatever it is called here."""
_POLL = 0.1
_PATIENCE = 20.0
"""Seconds that an interrupted command has to end by itself."""


@dataclass(frozen=True)
class Stage:
    """One command of `nerfgrasp`, run in the work's folder."""

    name: str
    """Unique; the record and the log are named by it."""
    command: tuple[str, ...]
    """Its arguments."""
    needs: tuple[str, ...] = ()
    """The stages that must be done before; they stand before it."""
    run: str | None = None
    """Of a `fit`: the run's folder. Where it has a checkpoint, the command goes on from the last."""
    rivals: tuple["Stage", ...] = ()
    """Short trainings, of which the one with the least loss over held-out scenes gives this one its `options`. One that
    diverges is the worst; it may."""
    options: tuple[str, ...] = ()
    """Of a rival: the arguments that set it apart."""
    gives: str = ""
    """The argument by which a later stage takes up its result."""
    config: str | None = None
    """Of a `fit`: the hash of what its configs say, which its command only names."""
    again: bool = False
    """Whether it is run every time, because it takes no time and what it reads may have changed."""


@dataclass(frozen=True)
class Record:
    """What is known of a stage that was started."""

    command: str
    """As it is typed."""
    seconds: float = 0.0
    """Wall time so far, over all starts."""
    finished: str | None = None
    """When it ended well, or diverged; None if it has not."""
    diverged: str | None = None
    """Of a rival: at which step its loss or gradient was not finite, and what it was; None if all were."""
    config: str | None = None
    """The stage's, when it was begun; None where that was not noted."""


@dataclass
class Running:
    """A stage whose command runs."""

    stage: Stage
    process: subprocess.Popen[bytes]
    since: float
    """When it was started, seconds since the epoch."""
    before: Record
    """As of then."""
    begin: float = field(default_factory=time.monotonic)

    def record(self) -> Record:
        """Returns the record as of now."""
        return replace(self.before, seconds=self.before.seconds + time.monotonic() - self.begin)


class Work:
    """Stages in a folder.

    Args:
        folder: where the commands run, and everything is written.
        stages: in an order in which they can be done.
        program: what takes their arguments.

    Raises:
        UserError: a stage is recorded there that was another command, or of another config.
    """

    def __init__(self, folder: Path, stages: Sequence[Stage], program: Sequence[str] = PROGRAM) -> None:
        self.folder, self.stages, self.program = folder, tuple(stages), program
        for stage in stages:
            record = self.record(stage)
            if record is not None and not stage.again:
                self._check(stage, record)

    def record(self, stage: Stage) -> Record | None:
        """Returns what is recorded of a stage; a damaged record is a UserError."""
        path = self._path(stage, ".json")
        if not path.exists():
            return None
        try:
            return Record(**read_json(path))
        except TypeError as error:
            raise UserError(f"{path} is damaged ({error}): remove it") from error

    def _check(self, stage: Stage, record: Record) -> None:
        was = f"stage {stage.name} in {self.folder} was"
        # What rivals give is known only once they are done, and always comes last.
        if not f"{record.command} ".startswith(f"{typed(stage)} "):
            raise UserError(f"{was} another command ({record.command}), now {typed(stage)}: give a new folder")
        if None not in (record.config, stage.config) and record.config != stage.config:
            raise UserError(
                f"{was} begun when its configs said something else ({record.config}, now {stage.config}): "
                "restore them, or give a new folder"
            )

    def done(self, stage: Stage) -> bool:
        """Returns whether a stage need not be run."""
        record = self.record(stage)
        return not stage.again and record is not None and record.finished is not None

    def state(self, stage: Stage) -> str:
        """Returns in words how far a stage is."""
        record = self.record(stage)
        if record is None:
            return "to do"
        begun = "running," if self._runs(stage) else "begun,"
        how = "diverged," if record.diverged else "done in" if record.finished else begun
        return f"{how} {clock(record.seconds)}"

    def run(self, jobs: int = 1) -> None:
        """Runs what is not done, `jobs` commands at a time, each on its share of the processors.

        Another process that works in the folder is waited for, also a command that a killed one left running. Once a
        stage has failed no other is begun; those that run end in their own time.

        Raises:
            UserError: a command failed; its name and its log are named.
        """
        make_folder(self.folder / FOLDER)
        with _claimed(self.folder / FOLDER / "lock") as lock:
            left = [stage for stage in self.stages if not self.done(stage)]
            print(f"{self.folder}: {len(self.stages)} stages, {len(self.stages) - len(left)} done", flush=True)
            running: list[Running] = []
            failures: list[str] = []
            try:
                while running or (left and not failures):
                    try:
                        for stage in [] if failures else self._ready(left, running, jobs):
                            left.remove(stage)
                            running.append(self._start(stage, jobs, lock))
                        self._wait(running, len(left))
                    except UserError as error:
                        failures.append(str(error))
                        if running:
                            names = ", ".join(one.stage.name for one in running)
                            print(f"{error}; nothing more is begun, but {names} may end", flush=True)
            finally:
                for one in running:
                    self._interrupt(one)
            if failures:
                raise UserError("; ".join(failures))

    def _ready(self, left: list[Stage], running: list[Running], jobs: int) -> list[Stage]:
        waiting = {stage.name for stage in left} | {one.stage.name for one in running}
        ready = [stage for stage in left if not waiting & {*stage.needs, *(rival.name for rival in stage.rivals)}]
        return ready[: jobs - len(running)]

    def _start(self, stage: Stage, jobs: int, lock: int) -> Running:
        command = [*stage.command, *(self._best(stage).options if stage.rivals else ())]
        noted = self.record(stage) or Record("")
        before = replace(noted, command=as_typed(command), finished=None, config=stage.config)
        if stage.run is not None and any((self.folder / stage.run / "checkpoints").glob("last*.ckpt")):
            command += ["--ckpt_path", "last"]
        number = self.stages.index(stage) + 1
        print(f"[{number} of {len(self.stages)}] {stage.name}: {as_typed(command)}", flush=True)
        share = str(max(1, (os.cpu_count() or 1) // jobs))
        limits = {"OMP_NUM_THREADS": share, "LOKY_MAX_CPU_COUNT": share} if jobs > 1 else {}
        write_json(self._path(stage, ".json"), asdict(before))
        since = time.time()
        with self._path(stage, ".log").open("ab") as log:
            # Held by the command, which writes to it, for as long as it runs: see `_runs`.
            fcntl.flock(log, fcntl.LOCK_SH)
            process = subprocess.Popen(
                [*self.program, *command],
                cwd=self.folder,
                env=os.environ | limits,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=[lock],  # held for as long as the command runs, even if this process is killed
            )
        return Running(stage, process, since, before)

    def _wait(self, running: list[Running], left: int) -> None:
        """Returns when one or more of the running stages have ended, and removes them."""
        shown = time.monotonic()
        while True:
            for one in [one for one in running if one.process.poll() is not None]:
                running.remove(one)
                self._ended(one, left + len(running))
                shown = 0.0
            if shown == 0.0:
                return
            if time.monotonic() - shown > HEARTBEAT:
                shown = time.monotonic()
                for one in running:
                    write_json(self._path(one.stage, ".json"), asdict(one.record()))
                self._show(running, left)
            time.sleep(_POLL)

    def _ended(self, one: Running, left: int) -> None:
        record, status, diverged = one.record(), one.process.returncode, None
        if status != 0 and any(one.stage in stage.rivals for stage in self.stages):
            diverged = self._divergence(one)
        if status == 0 or diverged is not None:
            now = datetime.now().astimezone().isoformat(timespec="seconds")
            record = replace(record, finished=now, diverged=diverged)
        write_json(self._path(one.stage, ".json"), asdict(record))
        if record.finished is None:
            log = self._path(one.stage, ".log")
            raise UserError(f"stage {one.stage.name} ended with status {status}: {record.command}; its log is {log}")
        how = "done" if diverged is None else f"diverged ({diverged})"
        print(f"{one.stage.name}: {how} in {clock(record.seconds)}, {left} left", flush=True)

    def _divergence(self, one: Running) -> str | None:
        from nerfgrasp.training.callbacks import why_not_finite

        return why_not_finite(self.folder / str(one.stage.run), one.since)

    def _show(self, running: list[Running], left: int) -> None:
        if sys.stdout.isatty():
            states = ", ".join(f"{one.stage.name} {clock(one.record().seconds)}" for one in running)
            words = _last_line(self._path(running[0].stage, ".log"))
            print(f"  {states}; {left} left | {words}\033[K", end="\r", flush=True)

    def _interrupt(self, one: Running) -> None:
        one.process.send_signal(signal.SIGINT)
        try:
            one.process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            one.process.kill()
            one.process.wait()
        write_json(self._path(one.stage, ".json"), asdict(one.record()))

    def _best(self, stage: Stage) -> Stage:
        losses = {rival.name: self._loss(rival) for rival in stage.rivals}
        told = ", ".join(f"{name}: {loss:.3f}" for name, loss in losses.items())
        if not any(map(math.isfinite, losses.values())):
            raise UserError(f"stage {stage.name}: all of its short trainings diverged ({told})")
        best = min(stage.rivals, key=lambda rival: losses[rival.name])
        print(f"{told}; best: {best.name}", flush=True)
        return best

    def _loss(self, rival: Stage) -> float:
        record = self.record(rival)
        return math.inf if record and record.diverged else held_out_loss(self.folder / str(rival.run))

    def _runs(self, stage: Stage) -> bool:
        """Returns whether a stage's command runs now, whoever started it, by the lock on its log."""
        try:
            with self._path(stage, ".log").open("rb") as log:
                fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
        return False

    def _path(self, stage: Stage, suffix: str) -> Path:
        return self.folder / FOLDER / f"{stage.name}{suffix}"


def typed(stage: Stage) -> str:
    """Returns a stage's command as it is typed."""
    return as_typed(stage.command)


def as_typed(command: Sequence[str]) -> str:
    """Returns arguments of `nerfgrasp` as a line for a shell."""
    return f"nerfgrasp {shlex.join(command)}"


def clock(seconds: float) -> str:
    """Returns hours, minutes and seconds.

    Example:
        >>> clock(3661.7)
        '1:01:01'
    """
    return str(timedelta(seconds=int(seconds)))


def held_out_loss(run: Path) -> float:
    """Returns the last `val/loss` that a run's CSVLogger wrote; infinite if that is no number.

    Raises:
        UserError: it wrote none.
    """
    versions = sorted(run.glob("lightning_logs/version_*"), key=lambda path: int(path.name.rpartition("_")[2]))
    for path in (version / "metrics.csv" for version in reversed(versions)):
        if path.exists():
            with path.open(newline="") as file:
                losses = [float(row["val/loss"]) for row in csv.DictReader(file) if row.get("val/loss")]
            if losses:
                return losses[-1] if math.isfinite(losses[-1]) else math.inf
    raise UserError(f"{run}: no val/loss in lightning_logs")


@contextmanager
def _claimed(path: Path) -> Iterator[int]:
    """Holds a lock, which the commands inherit; yields its file's number."""
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"waiting for the process that works in {path.parent.parent}", flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield file.fileno()


def _last_line(path: Path, width: int = 60) -> str:
    """Returns the end of a log, where a progress bar may be redrawn."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 2000))
        lines = file.read().decode(errors="replace").replace("\r", "\n").split("\n")
    return next((line.strip()[:width] for line in reversed(lines) if line.strip()), "")
