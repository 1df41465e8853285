import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfgrasp.commands.stages import Stage, Work, held_out_loss
from nerfgrasp.errors import UserError

STUB = """
import sys, time
from pathlib import Path
with open("ran", "a") as file:
    file.write(" ".join(sys.argv[1:]) + "\\n")
verb, *names = sys.argv[1:]
if verb == "meet":
    Path(names[0]).touch()
if verb in ("wait", "meet"):
    while not Path(names[-1]).exists():
        time.sleep(0.01)
if verb == "fail" and not Path(names[-1]).exists():
    print("no", names[-1], flush=True)
    sys.exit(3)
if verb == "diverge":
    run = Path(names[-1])
    run.mkdir(parents=True, exist_ok=True)
    (run / "not-finite-step-7.pt").write_bytes(Path("kept.pt").read_bytes())
    sys.exit(2)
"""


@pytest.fixture
def work(tmp_path: Path) -> Callable[[Sequence[Stage]], Work]:
    """Returns a function of stages: their commands do what `STUB` says, and note in `ran` that they were run."""
    (tmp_path / "stub.py").write_text(STUB)
    folder = tmp_path / "work"
    folder.mkdir()
    return lambda stages: Work(folder, stages, (sys.executable, str(tmp_path / "stub.py")))


def ran(work: Work) -> list[str]:
    return (work.folder / "ran").read_text().splitlines()


def test_each_stage_is_run_once_and_timed(work: Callable[..., Work], capsys: pytest.CaptureFixture[str]) -> None:
    stages = [Stage("a", ("do", "a")), Stage("b", ("do", "b"), ("a",)), Stage("last", ("do", "last"), again=True)]
    work(stages).run()
    assert ran(work(stages)) == ["do a", "do b", "do last"]
    out = capsys.readouterr().out
    assert "[2 of 3] b: nerfgrasp do b\nb: done in 0:00:0" in out
    record = json.loads((work(stages).folder / "stages" / "b.json").read_text())
    assert record["command"] == "nerfgrasp do b"
    assert record["seconds"] > 0
    assert record["finished"] is not None
    work([*stages[:2], Stage("c", ("do", "c")), stages[2]]).run()
    assert ran(work(stages)) == ["do a", "do b", "do last", "do c", "do last"]
    assert "4 stages, 2 done" in capsys.readouterr().out


KILLED = """
import sys
from pathlib import Path
from nerfgrasp.commands.stages import Stage, Work
stages = [Stage("a", ("do", "a")), Stage("b", ("wait", "go")), Stage("c", ("do", "c"))]
Work(Path("work"), stages, (sys.executable, str(Path("stub.py").resolve()))).run()
"""


def test_a_killed_run_goes_on_when_what_it_left_has_ended(
    work: Callable[..., Work], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stages = [Stage("a", ("do", "a")), Stage("b", ("wait", "go")), Stage("c", ("do", "c"))]
    process = subprocess.Popen([sys.executable, "-c", KILLED], cwd=tmp_path, stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while not (tmp_path / "work" / "ran").exists() or len(ran(work(stages))) < 2:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()
    left = work(stages)
    assert [left.done(stage) for stage in stages] == [True, False, False]
    # What the killed one had started still runs: two must not work on the same files.
    assert left.state(stages[1]) == "running, 0:00:00"
    threading.Timer(0.3, (tmp_path / "work" / "go").touch).start()
    left.run()
    assert "waiting for the process that works in" in capsys.readouterr().out
    assert ran(left) == ["do a", "wait go", "wait go", "do c"]
    assert left.state(stages[1]).startswith("done in ")


def test_a_failure_stops_with_its_command_and_its_log(work: Callable[..., Work]) -> None:
    stages = [Stage("a", ("do", "a")), Stage("b", ("fail", "the file")), Stage("c", ("do", "c"))]
    log = work(stages).folder / "stages" / "b.log"
    with pytest.raises(UserError) as failed:
        work(stages).run()
    assert str(failed.value) == f"stage b ended with status 3: nerfgrasp fail 'the file'; its log is {log}"
    assert log.read_text() == "no the file\n"
    (log.parent.parent / "the file").touch()
    work(stages).run()
    assert ran(work(stages)) == ["do a", "fail the file", "fail the file", "do c"]


def test_two_at_once_and_a_failure_lets_the_other_end(
    work: Callable[..., Work], capsys: pytest.CaptureFixture[str]
) -> None:
    stages = [Stage("a", ("meet", "A", "B")), Stage("b", ("meet", "B", "A"))]
    work(stages).run(jobs=2)
    more = [*stages, Stage("slow", ("wait", "go")), Stage("f", ("fail", "x")), Stage("g", ("do", "g"))]
    log = work(more).folder / "stages" / "f.log"

    def release() -> None:
        while not (log.exists() and log.read_text()):
            time.sleep(0.01)
        time.sleep(0.3)
        (log.parent.parent / "go").touch()

    threading.Thread(target=release, daemon=True).start()
    with pytest.raises(UserError, match="^stage f ended with status 3"):
        work(more).run(jobs=2)
    out = capsys.readouterr().out
    assert "f.log; nothing more is begun, but slow may end\nslow: done in 0:00:0" in out
    assert [work(more).done(stage) for stage in more] == [True, True, True, False, False]
    assert "do g" not in ran(work(more))


def test_an_interrupt_ends_what_runs(work: Callable[..., Work], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(running: object, left: int) -> None:
        raise KeyboardInterrupt

    endless = work([Stage("endless", ("wait", "never"))])
    monkeypatch.setattr(endless, "_wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        endless.run()
    assert endless.state(endless.stages[0]).startswith("begun, ")


def test_the_best_rival_s_options_are_taken(work: Callable[..., Work], capsys: pytest.CaptureFixture[str]) -> None:
    rivals = tuple(Stage(f"rate-{n}", ("do", "--rate", n), run=f"runs/{n}", options=("--rate", n)) for n in "123")
    final = Stage("final", ("do",), rivals=rivals, run="runs/final")
    for number, losses in (("1", "2.5,,1.5"), ("2", "2.5,,1.25"), ("3", "1.0,,nan")):
        folder = work([]).folder / "runs" / number / "lightning_logs" / "version_0"
        folder.mkdir(parents=True)
        (folder / "metrics.csv").write_text("val/loss,step\n" + "".join(f"{loss},\n" for loss in losses.split(",")))
    (work([]).folder / "runs" / "final" / "checkpoints").mkdir(parents=True)
    (work([]).folder / "runs" / "final" / "checkpoints" / "last.ckpt").touch()
    work([*rivals, final]).run()
    assert ran(work([]))[-1] == "do --rate 2 --ckpt_path last"
    assert "best: rate-2" in capsys.readouterr().out
    assert work([*rivals, final]).done(final)
    with pytest.raises(UserError, match="no val/loss"):
        held_out_loss(work([]).folder / "runs" / "final")


def test_a_rival_that_diverges_is_the_worst(work: Callable[..., Work], capsys: pytest.CaptureFixture[str]) -> None:
    folder = work([]).folder
    torch.save({"step": 7, "reason": "the loss is nan", "batch": {}}, folder / "kept.pt")
    (folder / "runs" / "2" / "lightning_logs" / "version_0").mkdir(parents=True)
    (folder / "runs" / "2" / "lightning_logs" / "version_0" / "metrics.csv").write_text("val/loss\n9.5\n")
    rivals = tuple(
        Stage(f"rate-{n}", (verb, f"runs/{n}"), run=f"runs/{n}", options=("--rate", n))
        for n, verb in (("1", "diverge"), ("2", "do"), ("3", "diverge"))
    )
    stages = [*rivals, Stage("final", ("do",), rivals=rivals)]
    for _ in range(2):
        work(stages).run()
        assert ran(work(stages)) == ["diverge runs/1", "do runs/2", "diverge runs/3", "do --rate 2"]
    record = json.loads((folder / "stages" / "rate-1.json").read_text())
    assert record["diverged"] == "step 7: the loss is nan"
    assert record["finished"] is not None
    assert work(stages).state(rivals[0]).startswith("diverged, 0:00:0")
    out = capsys.readouterr().out
    assert "rate-1: diverged (step 7: the loss is nan) in 0:00:0" in out
    assert "rate-1: inf, rate-2: 9.500, rate-3: inf; best: rate-2" in out

    two = (rivals[0], rivals[2])
    with pytest.raises(UserError, match=r"^stage last: all of its short trainings diverged \(rate-1: inf, rate-3: inf"):
        work([*two, Stage("last", ("do",), rivals=two)]).run()
    # The file of an earlier time says nothing of a failure now, and only a rival may diverge.
    again = Stage("rate-4", ("fail", "x"), run="runs/1")
    with pytest.raises(UserError, match="stage rate-4 ended with status 3"):
        work([again, Stage("last", ("do",), rivals=(again,))]).run()
    with pytest.raises(UserError, match="stage alone ended with status 2"):
        work([Stage("alone", ("diverge", "runs/5"), run="runs/5")]).run()


def test_another_command_under_the_same_name_is_refused(work: Callable[..., Work]) -> None:
    work([Stage("a", ("do", "a"))]).run()
    with pytest.raises(UserError, match=r"was another command \(nerfgrasp do a\), now nerfgrasp do b: give a new"):
        work([Stage("a", ("do", "b"))])


def test_another_config_under_the_same_name_is_refused(work: Callable[..., Work]) -> None:
    stage = Stage("a", ("fit", "--config", "a.yaml"), config="0123")
    failing = Stage("b", ("fail", "b"), config="4567")
    with pytest.raises(UserError, match="stage b ended"):
        work([stage, failing]).run()
    for changed in (replace(stage, config="89ab"), replace(failing, config="cdef")):
        with pytest.raises(UserError, match=f"stage {changed.name} .* said something else .*now {changed.config}"):
            work([changed])
    work([stage, failing])
    path = work([]).folder / "stages" / "a.json"
    record = json.loads(path.read_text())
    del record["config"]
    path.write_text(json.dumps(record))
    left = work([replace(stage, config="89ab")])
    assert left.done(left.stages[0]), "a record that does not know it stays valid"
