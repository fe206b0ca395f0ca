"""Write docs/data/policies.json, the index of the policies that studies have published.

Run: python -m docs.index_policies
Expect: seconds. A row has the study, name and kind of a policy, the seed of its training, its folder, and the
SHA-256 of the folder's files.
"""

import hashlib
import json
from pathlib import Path

from core.files import write_atomic

DATA = Path(__file__).with_name("data")
INDEX = DATA / "policies.json"


def index_rows(data: Path = DATA) -> list[dict[str, str | int]]:
    """Read all policies of the folders `STUDY_policies`, in the order of their paths."""
    rows: list[dict[str, str | int]] = []
    for manifest in sorted(data.glob("*_policies/*/policy.json")):
        folder, values = manifest.parent, json.loads(manifest.read_text(encoding="utf-8"))
        name, _, seed = folder.name.rpartition("-s")
        rows.append(
            {
                "study": folder.parent.name.removesuffix("_policies"),
                "name": name,
                "kind": values["name"],
                "seed": int(seed),
                "path": folder.relative_to(data.parent).as_posix(),
                "sha256": folder_digest(folder),
            }
        )
    return rows


def folder_digest(folder: Path) -> str:
    """Return the SHA-256 of what `sha256sum *` prints in a folder."""
    sums = [
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in sorted(folder.iterdir())
    ]
    return hashlib.sha256("".join(sums).encode()).hexdigest()


def index_text(rows: list[dict[str, str | int]]) -> str:
    """Return the index as JSON with one policy per line."""
    return "[\n" + ",\n".join(f"  {json.dumps(row)}" for row in rows) + "\n]\n"


if __name__ == "__main__":
    write_atomic(INDEX, index_text(index_rows()))
