"""Count lines of code: lines with a token, without docstrings, comments and blank lines.

Run: python .ci/lines.py (make lines)
Expect: lines and files of each package of the product, of the whole product, and outside the wheel.
"""

import ast
import io
import subprocess
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ("core", "envs", "models", "jobs", "platform")
OTHERS = ("tests", "benchmarks", "research", "docs")
EMPTY = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def code_lines(source: str) -> int:
    """Return the number of lines of a Python source that hold code."""
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in EMPTY:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - _docstring_lines(ast.parse(source)))


def _docstring_lines(tree: ast.AST) -> set[int]:
    """Return the lines of all docstrings, including strings that document an attribute above them."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def main() -> None:
    """Print the table of lines and files."""
    command = ["git", "ls-files", "*.py"]
    tracked = subprocess.check_output(command, cwd=ROOT, text=True).splitlines()
    lines, files = Counter[str](), Counter[str]()
    for name in tracked:
        path, room = ROOT / name, Path(name).parts
        if not path.is_file() or room[0] not in (*PRODUCT, *OTHERS):
            continue
        count = code_lines(path.read_text())
        keys = {room[0], "product"} if room[0] in PRODUCT else {room[0]}
        if room[0] == "jobs":
            keys.add("jobs/" + (room[1] if len(room) > 2 else ""))
        for key in keys:
            lines[key] += count
            files[key] += 1
    jobs = sorted(key for key in lines if key.startswith("jobs/"))
    order = ["core", "envs", "models", "jobs", *jobs, "platform", "product", *OTHERS]
    for key in order:
        print(f"{key:18}{lines[key]:>8,} lines {files[key]:>5} files")


if __name__ == "__main__":
    main()
