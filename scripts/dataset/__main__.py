"""Datasheet of files of `codesign sample`: counts, schema, checksums, in docs/notes/dataset.md.

The text of the page is written by hand; what stands between its marks comes from the files.
"""

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

from codesign_jax.runs import parquet
from scripts.shared import provenance, tables
from scripts.shared.output import write_json

PAGE, RESULT = Path("docs/notes/dataset.md"), Path("docs/data/dataset.json")


def described(path: Path) -> dict[str, Any]:
    """Numbers, schema and SHA-256 digest of a file of `codesign sample`."""
    pa = parquet.pyarrow_module("scripts.dataset")
    file = pa.parquet.ParquetFile(path)
    metadata = {k.decode(): v.decode() for k, v in file.schema_arrow.metadata.items()}
    question = json.loads(metadata["question"])
    ends: dict[str, dict[str, int]] = {}
    for group in range(file.num_row_groups):
        part = file.read_row_group(group, columns=["object", "verdict"])
        for row in part.group_by(["object", "verdict"]).aggregate([([], "count_all")]).to_pylist():
            own = ends.setdefault(row["object"], {})
            own[row["verdict"]] = own.get(row["verdict"], 0) + row["count_all"]
    with path.open("rb") as opened:
        digest = hashlib.file_digest(opened, "sha256").hexdigest()
    found = {"file": path.name, "bytes": path.stat().st_size, "sha256": digest}
    found |= {"grasps": file.metadata.num_rows, "designs": json.loads(metadata["designs"])}
    found |= {name: question[name] for name in ("preset", "trials", "seed", "engine", "code")}
    environment = json.loads(metadata["environment"])
    return found | {"verdicts": ends, "schema": _schema(file), "environment": environment}


def _schema(file: Any) -> list[dict[str, str]]:
    columns = []
    for field in file.schema_arrow:
        more = {k.decode(): v.decode() for k, v in (field.metadata or {}).items()}
        own = {"name": field.name, "type": str(field.type), "unit": more.get("unit", "")}
        columns.append(own | {"meaning": more.get("description", "")})
    return columns


def table(files: list[dict[str, Any]]) -> str:
    """A row for each file: its grasps, how they end, and its digest."""
    rows = [["file", "grasps", "designs", "trials", "kept", "lost", "stuck", "failed", "MB"]]
    for file in files:
        total = {v: sum(own.get(v, 0) for own in file["verdicts"].values()) for v in rows[0][4:8]}
        shares = [f"{100 * n / file['grasps']:.2f} %" for n in total.values()]
        counts = [f"{file[n]:,}" for n in ("grasps", "designs", "trials")]
        rows.append([f"`{file['file']}`", *counts, *shares, f"{file['bytes'] / 1e6:.1f}"])
    sums = "\n".join(f"{file['sha256']}  {file['file']}" for file in files)
    return f"{tables.markdown(rows)}\n\n```\n{sums}\n```"


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = provenance.parser(__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="Parquet files of `codesign sample`")
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--json", type=Path, default=RESULT)
    args: argparse.Namespace = parser.parse_args(arguments)
    files = [described(path) for path in args.files]
    write_json(args.json, {"files": files, "provenance": provenance.results(args.commit)})
    tables.fill(args.page, table(files), "files")
    print(table(files))
    return 0


if __name__ == "__main__":
    sys.exit(main())
