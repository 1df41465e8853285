import errno
import resource
import subprocess
import sys
from calendar import Calendar
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import pytest

from nerfgrasp import __version__, cli
from nerfgrasp.errors import UserError


@dataclass
class Sizes:
    width: int = 1
    count: int = 1


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., object]], None]:
    """Returns a function that registers another function as the command `fake`."""

    def register(function: Callable[..., object]) -> None:
        module = ModuleType("nerfgrasp.commands.fake")
        module.fake = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(cli.COMMANDS, "fake", "for a test")

    return register


def raises(error: BaseException) -> Callable[[], None]:
    def command() -> None:
        raise error

    return command


def refusal(capsys: pytest.CaptureFixture[str], args: list[str]) -> str:
    """Runs a command that must be refused, and returns its one line."""
    assert cli.main(args) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("nerfgrasp: error: ")
    return err.removeprefix("nerfgrasp: error: ").rstrip("\n")


@pytest.mark.parametrize("args", [[], ["--help"], ["-h"]])
def test_help_names_every_command(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(args) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in cli.COMMANDS)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"nerfgrasp {__version__}\n"


def test_unknown_command_names_near_misses(capsys: pytest.CaptureFixture[str]) -> None:
    assert refusal(capsys, ["optimise", "--scene", "demo"]).startswith(
        "unknown command 'optimise': did you mean 'optimize'?"
    )


def test_arguments_are_parsed_by_the_signature(fake, capsys: pytest.CaptureFixture[str], tmp_path) -> None:
    config = tmp_path / "fake.yaml"
    config.write_text("scene: demo\ncount: 3\n")

    def command(scene: str, count: int = 1) -> None:
        print(scene, count)

    fake(command)
    assert cli.main(["fake", "--scene", "demo"]) == 0
    assert cli.main(["fake", "--config", str(config), "--count", "5"]) == 0
    assert capsys.readouterr().out == "demo 1\ndemo 5\n"


@pytest.mark.parametrize(
    ("args", "names"),
    [
        (["--name", "one"], ("one",)),
        (["--name", "one", "two", "--count", "3"], ("one", "two")),
        (["--count=3", "--name=one", "two/a b"], ("one", "two/a b")),
        (["--name", "[one, two]"], ("one", "two")),
        (["--name=[one, two]"], ("one", "two")),
        (["--name=[]"], ()),
        ([], ("default",)),
    ],
)
def test_an_option_may_take_many(fake, args: list[str], names: tuple[str, ...]) -> None:
    found: list[tuple[str, ...]] = []

    def command(name: tuple[str, ...] = ("default",), count: int = 1) -> None:
        found.append(name)

    fake(command)
    assert cli.main(["fake", *args]) == 0
    assert found == [names]


def test_an_option_that_takes_many_needs_one(fake, capsys: pytest.CaptureFixture[str]) -> None:
    def command(name: tuple[str, ...] = ("default",), count: int = 1) -> None:
        raise AssertionError("the command is not run")

    fake(command)
    assert refusal(capsys, ["fake", "--name", "--count=2"]) == "argument --name: expected one argument"


def test_print_config(fake, capsys: pytest.CaptureFixture[str]) -> None:
    def command(scene: str = "demo", count: int = 1) -> None:
        raise AssertionError("the command is not run")

    fake(command)
    with pytest.raises(SystemExit) as done:
        cli.main(["fake", "--count=4", "--print_config"])
    assert done.value.code == 0
    assert capsys.readouterr().out == "scene: demo\ncount: 4\n"


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["--scen=demo"], "unrecognized arguments: --scen=demo (did you mean --scene?)"),
        (["--scene=demo", "--cuont", "3"], "unrecognized arguments: --cuont 3 (did you mean --count?)"),
        (["--scene=demo", "stray"], "unrecognized arguments: stray"),
        (["--scene=demo", "--count=many"], "'count': expected int. Got value: many"),
        (["--scene=demo", "--limit=1.5"], "'limit': expected int. Given value: 1.5"),
        (["--scene"], "argument --scene: expected one argument"),
        ([], "the following arguments are required: scene"),
        (["--config=not_there.yaml"], "'config': File does not exist: "),
        (["--config={scen: demo}"], "Option 'scen' is not accepted (did you mean 'scene'?)"),
        (["--config={scene: ["], "'config': while parsing a flow node"),
    ],
)
def test_a_wrong_option_is_one_line(args: list[str], line: str, fake, capsys: pytest.CaptureFixture[str]) -> None:
    def command(scene: str, count: int = 1, limit: int | None = None) -> None:
        raise AssertionError("the command is not run")

    fake(command)
    assert refusal(capsys, ["fake", *args]).startswith(line)


def test_a_wrong_key_in_a_config_file_is_one_line(fake, capsys: pytest.CaptureFixture[str], tmp_path) -> None:
    def command(scene: str = "demo") -> None:
        raise AssertionError("the command is not run")

    fake(command)
    config = tmp_path / "fake.yaml"
    config.write_text("scen: demo\n")
    assert refusal(capsys, ["fake", "--config", str(config)]) == "Option 'scen' is not accepted (did you mean 'scene'?)"


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (
            ["--calendar.firstweekdy=3"],
            "'calendar': Problem with given class_path 'calendar.TextCalendar': "
            "Option 'firstweekdy' is not accepted (did you mean 'firstweekday'?)",
        ),
        (["--sizes.widht=3"], "unrecognized arguments: --sizes.widht=3 (did you mean --sizes.width?)"),
        (["--sizes={'widht': 3}"], "Group 'sizes' does not accept option 'widht' (did you mean 'width'?)"),
    ],
)
def test_near_misses_of_nested_keys(args: list[str], line: str, fake, capsys: pytest.CaptureFixture[str]) -> None:
    def command(calendar: Calendar, sizes: Sizes) -> None:
        raise AssertionError("the command is not run")

    fake(command)
    assert refusal(capsys, ["fake", "--calendar=calendar.TextCalendar", *args]) == line


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (UserError("scene demo:\n  no images"), "scene demo: no images"),
        (OSError(errno.ENOSPC, "No space left on device", "runs/a.npy"), "No space left on device: runs/a.npy"),
        (OSError(errno.EROFS, "Read-only file system", "runs"), "Read-only file system: runs"),
        (PermissionError(errno.EACCES, "Permission denied", "runs"), "Permission denied: runs"),
        (FileExistsError(errno.EEXIST, "File exists", "runs"), "File exists: runs"),
        (
            ModuleNotFoundError("No module named 'pybullet'", name="pybullet"),
            "this needs the package 'pybullet', which is not installed for this Python",
        ),
    ],
)
def test_a_mistake_of_the_user_is_one_line(error, line: str, fake, capsys: pytest.CaptureFixture[str]) -> None:
    fake(raises(error))
    assert refusal(capsys, ["fake"]) == line


def test_a_full_disk_is_told_however_deep_it_was_met(fake, capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> None:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise RuntimeError("writer failed") from error

    fake(command)
    assert refusal(capsys, ["fake"]) == "No space left on device"


@pytest.mark.parametrize(
    "error",
    [ValueError("a bug"), FileNotFoundError(errno.ENOENT, "No such file"), ModuleNotFoundError(name="nerfgrasp.gone")],
)
def test_a_mistake_of_ours_keeps_its_traceback(error, fake) -> None:
    fake(raises(error))
    with pytest.raises(type(error)):
        cli.main(["fake"])


@pytest.mark.parametrize("args", [["--debug", "fake"], ["fake", "--debug"]])
def test_debug_brings_the_traceback(args: list[str], fake) -> None:
    fake(raises(UserError("scene demo has no images")))
    with pytest.raises(UserError, match="no images"):
        cli.main(args)


def test_an_interrupt_exits_as_shells_expect(fake) -> None:
    fake(raises(KeyboardInterrupt()))
    assert cli.main(["fake"]) == 130


def test_a_command_decides_its_exit_status(fake) -> None:
    def command() -> int:
        return 3

    fake(command)
    assert cli.main(["fake"]) == 3


@pytest.mark.parametrize("args", [["--help"], ["plugins", "list"]])
def test_light_commands_start_in_half_a_second(args: list[str]) -> None:
    def seconds() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-P", "-m", "nerfgrasp", *args], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    assert min(seconds() for _ in range(3)) < 0.5


def test_a_flag_needs_no_value() -> None:
    from nerfgrasp.commands import parsing

    def command(*, execute: bool = False, count: int = 1) -> tuple[bool, int]:
        return execute, count

    for args, expected in (
        (["--execute"], (True, 1)),
        (["--execute", "--count", "2"], (True, 2)),
        (["--execute", "false"], (False, 1)),
        ([], (False, 1)),
    ):
        assert parsing.call(command, args, prog="command") == expected
