"""`nerfgrasp objects import SOURCE ... --out DIR`: object models from where their makers publish them."""

from collections.abc import Sequence
from pathlib import Path

from nerfgrasp.commands.arguments import Arguments
from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, remove_temporaries


def main(args: list[str]) -> int:
    """Runs the command on its arguments and returns its exit status."""
    parser = Arguments(prog="nerfgrasp objects", description="Object models of the task of novel objects.")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, dest="command")
    importing = commands.add_parser(
        "import",
        help="make a folder of objects out of archives or folders",
        description="Fetch, check and decompose object models, such as YCB's, into a folder for --objects.",
    )
    importing.add_argument("source", nargs="+", metavar="SOURCE", help="an archive (.tgz, .zip), its URL, or a folder")
    importing.add_argument("--out", required=True, type=Path, metavar="DIR", help="the folder to write or continue")
    importing.add_argument("--sha256", metavar="HEX", help="checksum of the archive, where there is one SOURCE")
    options = parser.parse_args(args)
    import_objects(options.source, options.out, sha256=options.sha256)
    return 0


def import_objects(sources: Sequence[str], out: Path, *, sha256: str | None = None) -> None:
    """Writes a folder of objects that `open_catalogue` reads, one folder an object.

    Each appears whole or not at all; a run that was stopped continues where the same command is given again, and
    what was fetched is not fetched again.

    Args:
        sources: archives, URLs of archives, or folders; of objects as YCB publishes them
            (`ID/google_16k/textured.obj`), of URDFs or of meshes.
        out: the folder.
        sha256: checksum of the one archive.

    Raises:
        UserError: a source cannot be had, is damaged or holds no objects, or `out` holds another object of the
            same name.
    """
    from nerfgrasp.sim.importing import import_source

    if sha256 is not None and len(sources) != 1:
        raise UserError(f"--sha256 is the checksum of one archive, and there are {len(sources)} sources")
    make_folder(out)
    remove_temporaries(out)
    for source in sources:
        for name, new in import_source(source, out, sha256):
            print(f"{out / name}: {'imported' if new else 'is already there'}")
