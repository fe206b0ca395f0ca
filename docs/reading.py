"""Measure how well the pages read: words, sentence lengths, and Flesch's reading ease.

Run from the repository root: python -m docs.reading [--check]
Prints one row per page. With --check the command fails if a page breaks a limit. The plans in docs/plans,
which are not changed after the data, are counted separately.
"""

import re
import statistics
import sys
from pathlib import Path
from typing import NamedTuple

import pyphen

from docs.contents import CONTENTS, PLANS

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
GENERATED = ("keys.md", "api.md", "changelog.md")  # from the schema, from docstrings, from the changelog
FIRST = ("README.md", *(f"docs/{name}.md" for name in ("index", "start", "task", "train", "sweep", "models")))
MOST_MEDIAN, MOST_WORDS, LEAST_EASE = 18, 35, 45.0  # median and longest sentence [words], reading ease
MOST_WORDS_ANYWHERE = 40  # longest sentence on any page [words]
MOST_SITE_WORDS, MOST_LINKS = 32_000, 42
BLOCKS = (
    re.compile(r"^(`{3,}|:{3,}).*?^\1\s*$", re.MULTILINE | re.DOTALL),  # code and directives
    re.compile(r"<(video|iframe)\b.*?</\1>", re.DOTALL),
    re.compile(
        r"^<!-- study .*?<!-- end of study -->", re.MULTILINE | re.DOTALL
    ),  # written by jobs.study.page
    re.compile(r"<!--.*?-->", re.DOTALL),
    re.compile(r"^\s*\|.*$", re.MULTILINE),  # tables
    re.compile(r"^#+ .*$", re.MULTILINE),
    re.compile(r"^(?: {4}|\t)(?![-*\d]).*$", re.MULTILINE),  # indented code
    re.compile(r"!\[[^\]]*\]\([^)]*\)"),
    re.compile(r"<[^>]+>"),
)
LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
ITEM = re.compile(r"^\s*(?:[-*]|\d+\.)\s+", re.MULTILINE)
WORD = re.compile(r"[A-Za-z]+(?:'[a-z]+)?")
SYLLABLES = pyphen.Pyphen(lang="en_US", left=1, right=1)
SENTENCE = re.compile(r"(?<=[.!?:])[*_)\"]*\s+(?=[\"(*_]*[A-Z0-9])|\n\s*\n")


class Reading(NamedTuple):
    """The readability of a page.

    Attributes:
        words: All words of the file, as `wc -w` counts.
        median: Median words per sentence; 0 without a sentence.
        longest: Words of the longest sentence.
        ease: Flesch's reading ease; 100 without a sentence.
        sentence: The longest sentence.
    """

    words: int
    median: float
    longest: int
    ease: float
    sentence: str


def sentences(text: str) -> list[str]:
    """Return the sentences of a page's prose: without code, tables, headings, pictures and HTML."""
    for block in BLOCKS:
        text = block.sub("\n\n", text)
    text = ITEM.sub("\n\n", LINK.sub(r"\1", text))
    text = re.sub(r"`[^`]*`", "Name", text.replace("&nbsp;", " "))
    parts = (" ".join(part.split()).strip("*_ ") for part in SENTENCE.split(text))
    return [part for part in parts if len(part.split()) > 2]


def measure(text: str) -> Reading:
    """Measure the readability of a page."""
    found = sentences(text)
    if not found:
        return Reading(len(text.split()), 0, 0, 100.0, "")
    longest = max(found, key=lambda one: len(one.split()))
    lengths = [len(one.split()) for one in found]
    words = len(text.split())
    return Reading(words, statistics.median(lengths), max(lengths), reading_ease(found), longest)


def reading_ease(prose: list[str]) -> float:
    """Return Flesch's reading ease of sentences: 100 is easy, 30 is for graduates (Flesch 1948).

    Syllables come from a hyphenation dictionary, which misses some, so that pages seem a little easier.
    """
    words = [word for one in prose for word in WORD.findall(one)]
    syllables = sum(1 + len(SYLLABLES.positions(word.lower())) for word in words)
    return 206.835 - 1.015 * len(words) / len(prose) - 84.6 * syllables / len(words)


def broken(page: str, found: Reading) -> list[str]:
    """Return one line for each limit that one of the first pages breaks."""
    wrong = []
    if found.median > MOST_MEDIAN:
        wrong.append(f"{page}: median sentence of {found.median:g} words; at most {MOST_MEDIAN}")
    if found.longest > MOST_WORDS:
        wrong.append(f"{page}: a sentence of {found.longest} words; at most {MOST_WORDS}: {found.sentence}")
    if found.ease < LEAST_EASE:
        wrong.append(f"{page}: reading ease {found.ease:.0f}; at least {LEAST_EASE:.0f}: shorter words")
    return wrong


def site_words() -> int:
    """Return the number of words of the site, without keys, API, changelog and the plans of docs/plans."""
    return sum(len(page.read_text().split()) for page in DOCS.glob("*.md") if page.name not in GENERATED)


def sidebar_links() -> int:
    """Return the number of pages in the sidebar."""
    return sum(map(len, CONTENTS.values()))


def check() -> list[str]:
    """Return one line for each broken limit: of the first pages, of any page, and of the whole site."""
    wrong = [line for page in FIRST for line in broken(page, measure((ROOT / page).read_text()))]
    for page in sorted(DOCS.glob("*.md")):
        if page.name not in GENERATED and (found := measure(page.read_text())).longest > MOST_WORDS_ANYWHERE:
            wrong.append(f"{page.name}: a sentence of {found.longest} words: {found.sentence}")
    if (words := site_words()) > MOST_SITE_WORDS:
        wrong.append(f"the site has {words:,} words; at most {MOST_SITE_WORDS:,}")
    if (links := sidebar_links()) > MOST_LINKS:
        wrong.append(f"the sidebar has {links} links; at most {MOST_LINKS}")
    return wrong


def table() -> str:
    """Return a table with one row per page, and the totals of the site."""
    pages = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
    lines = [f"{'page':28}{'words':>8}{'median':>8}{'longest':>8}{'ease':>6}"]
    for page in pages:
        one = measure(page.read_text())
        lines.append(f"{page.name:28}{one.words:8,}{one.median:8g}{one.longest:8}{one.ease:6.0f}")
    count = sum(page.name not in GENERATED for page in DOCS.glob("*.md"))
    lines.append(f"{count} pages of {site_words():,} words, {sidebar_links()} links in the sidebar")
    plans = [page.read_text().split() for page in PLANS]
    lines.append(f"{len(plans)} plans of {sum(map(len, plans)):,} words")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit("\n".join(check()) or 0)
    sys.stdout.write(table())
