"""`nerfgrasp table`: the paper's table from nothing, or from shipped models."""

from pathlib import Path

from nerfgrasp.commands.parsing import Parser, flags_set
from nerfgrasp.commands.ranges import check_ranges
from nerfgrasp.commands.recipe import LEARNED, TABLE, Experiment, Scale, not_shipped, shipped_name, table_stages
from nerfgrasp.commands.stages import Work, clock, typed
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.tables import Table, format_tables
from nerfgrasp.files import replacing
from nerfgrasp.sim.catalogue import chosen_folder, open_catalogue

TIMES = "times.md"
"""What each stage took."""


def main(args: list[str]) -> None:
    """Runs the command on its arguments.

    Raises:
        UserError: the arguments are wrong, or as `table` says.
    """
    parser = Parser(prog="nerfgrasp table", description="Makes the paper's table; see docs/table.md.")
    parser.add_argument("--config", action="config", help="a file of these options")
    what = f"rows of the table: {', '.join(LEARNED)}, registered methods, NAME=MODEL, or NAME=MODEL@SCHEDULE"
    parser.add_argument("--methods", nargs="+", default=list(LEARNED), help=what)
    parser.add_function_arguments(table, skip={"methods"})
    chosen = parser.parse_args(flags_set(table, args)).as_dict()
    chosen.pop("config", None)
    table(**chosen)


def table(
    *,
    out: Path,
    methods: list[str],
    scale: Scale = "laptop",
    evaluate_only: bool = False,
    scenes: int = 200,
    clutter_scenes: int = 40,
    novel_poses: int = 20,
    objects: Path | None = None,
    seeds: int = 3,
    jobs: int = 1,
    status: bool = False,
) -> None:
    """Makes data, trainings, evaluations and the report by the commands that one would type, in the folder OUT.

    Started again, it skips what is done and goes on with what was killed.

    Args:
        out: the folder of everything: data, runs, results, stages (records and logs), table.md, times.md. A set that
            lies in OUT/data already is used.
        methods: rows of the table.
        scale: of the training configs: `laptop` or `paper`.
        evaluate_only: try the shipped models instead of training; a method without one is told and left out.
        scenes: simple scenes that each method is tried in.
        clutter_scenes: scenes of clutter; 0 leaves the task out.
        novel_poses: poses of each novel object; 0 leaves the task out.
        objects: the folder of the novel objects, as for `evaluate`.
        seeds: trainings of MV3's and MV1's heads with different seeds.
        jobs: how many commands run at once, each on its share of the processors.
        status: tell how far it is, and run nothing.

    Raises:
        UserError: a method or config does not exist, no model of any method is shipped, OUT holds another table, or a
            command failed.
    """
    check_ranges(scenes=scenes, clutter_scenes=clutter_scenes, novel_poses=novel_poses, seeds=seeds, jobs=jobs)
    # As an absolute path: the commands run in another folder.
    objects = chosen_folder(objects) if novel_poses else None
    novel = novel_poses * len(open_catalogue(objects).names) if novel_poses else 0
    if evaluate_only:
        methods = _shipped(methods, scale)
    experiment = Experiment(out, tuple(methods), scale, evaluate_only, scenes, clutter_scenes, novel, objects, seeds)
    work = Work(out, table_stages(experiment))
    if not status:
        try:
            work.run(jobs)
        finally:
            _write_times(work)
        print(f"the table is {out / TABLE}")
    else:
        for stage in work.stages:
            print(f"{stage.name:<24} {work.state(stage):<20} {typed(stage)}")


def _shipped(methods: list[str], scale: Scale) -> list[str]:
    """Returns the methods without those that are to be trained first, which it names."""
    absent = not_shipped(methods, scale)
    if absent:
        names = ", ".join(shipped_name(name, scale) for name in absent)
        line = f"no model is shipped as {names}"
        if len(absent) == len(methods):
            raise UserError(f"{line}: nothing is left to try")
        print(f"{line}: left out of the table", flush=True)
    return [name for name in methods if name not in absent]


def _write_times(work: Work) -> None:
    records = [(stage, work.record(stage)) for stage in work.stages]
    begun = [(stage, record) for stage, record in records if record is not None]
    rows = [(stage.name, work.state(stage), f"`{record.command}`") for stage, record in begun]
    total = clock(sum(record.seconds for _, record in begun))
    note = f"Wall time of {len(begun)} of {len(records)} stages, over all their starts: {total} in sum."
    text = format_tables([Table("Stages", ("stage", "state", "command"), tuple(rows), (note,))], "markdown")
    with replacing(work.folder / TIMES) as temporary:
        temporary.write_text(text, encoding="utf-8")
