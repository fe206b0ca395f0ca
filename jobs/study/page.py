"""Fill the pages of a study: the parts between marks are generated from its data alone.

The rest of a page is written by hand. `<!-- study NAME PART -->` begins a part, `<!-- end of study -->` ends
it, and the text between them is replaced. The part `results` combines the usual parts; `provenance` states
command, commit and date. NAME:DATA takes the file of one study and the data of another.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.statistics import rate_estimate
from jobs.analysis.tables import markdown_table, percent_text
from jobs.study import tables
from jobs.study.changes import content, replicated
from jobs.study.computed import Study, place_beside
from jobs.study.contrasts import by_condition
from jobs.study.figures import CAPTIONS, KINDS, NEEDED
from jobs.study.results import Condition, Results, value_of, values_of
from jobs.study.spread import crossed_tables, factors
from jobs.study.summaries import MET, success_lines
from jobs.study.words import condition_text

MARK = re.compile(r"(<!-- study ([\w:]+) ([\w:]+) -->\n).*?(<!-- end of study -->\n)", re.DOTALL)
NEW_PAGE = "# {name}\n\n{results}\n{provenance}"
EMPTY = "<!-- study {name} {part} -->\n<!-- end of study -->\n"
FOUND_MET = f"{MET} The condition lies within what the group was trained on."


def figures(study: Study) -> dict[str, Figure]:
    """Draw the figures of a study for which it has the data; return name -> figure."""
    return {name: KINDS[said["kind"]](study, said) for name, said in _figures(study).items()}


def _figures(study: Study) -> dict[str, Mapping[str, Any]]:
    return {
        name: said
        for name, said in (study.said.get("figures") or {}).items()
        if said["kind"] not in NEEDED or NEEDED[said["kind"]](study, said)
    }


def part(study: Study, name: str) -> str:
    """Return a part of a study's pages as Markdown.

    Raises:
        KeyError: No part has this name.
    """
    kind, _, own = name.partition(":")
    return PARTS[kind](study, own).strip("\n")


def fill(text: str, find: Callable[[str, str], str]) -> str:
    """Return the text of a page with its parts filled.

    Args:
        text: Text of the page.
        find: Returns the Markdown for a mark's study name and part.
    """
    return MARK.sub(lambda found: f"{found[1]}\n{find(found[2], found[3])}\n\n{found[4]}", text)


def marked(texts: Iterable[str]) -> list[str]:
    """Return the names of the studies with marks on these pages."""
    return list(dict.fromkeys(found[2] for text in texts for found in MARK.finditer(text)))


def new_page(name: str) -> str:
    """Return a page with marks for the results and the provenance of a study."""
    parts = {part: EMPTY.format(name=name, part=part) for part in ("results", "provenance")}
    return NEW_PAGE.format(name=name, **parts)


def _results(study: Study, _: str) -> str:
    blocks = [_summary(study, ""), *(_figure(study, name) for name in _figures(study))]
    columns = {place_beside(other, name) for name, (family, _) in study.families.items()
               for other in family.beside.values()}  # fmt: skip
    blocks += [
        _family(study, name, heading=True) for name in study.families if (study.name, name) not in columns
    ]
    if study.said.get("spread"):
        blocks.append(f"### By {study.said['spread']['rows']} and by {study.said['spread']['columns']}\n\n"
                      f"{_spread(study, '')}")  # fmt: skip
    if study.doses:
        blocks += [f"### Every change\n\n{_changes(study, '')}",
                   f"### Which trainings lose\n\n{tables.broken_table(study.changes)}"]  # fmt: skip
    file = f"{study.name}_trainings.csv"
    blocks.append(f"Success of every run under each condition: [`{file}`](data/{file}).")
    return "\n\n".join(block.strip("\n") for block in blocks if block)


def _summary(study: Study, _: str) -> str:
    results = study.results
    said = [tables.lead_sentence(results, own) if name == "lead" else tables.family_sentence(family, own)
            for name, (family, own) in study.families.items()]  # fmt: skip
    if study.said.get("spread"):
        overall, _each, names, mean = _crossed(study)
        said.append(tables.spread_sentence(overall, names, mean))
    if not study.said.get("variants"):
        said.append(tables.worst_sentence(results, study.changes))
    return "\n".join(f"- {one}" for one in said if one)


def _figure(study: Study, name: str) -> str:
    caption = CAPTIONS[_figures(study)[name]["kind"]]
    return f"![{caption.split('.')[0]}](images/{name}.png)\n\n{caption}"


def _family(study: Study, name: str, heading: bool = False) -> str:
    family, findings = study.families[name]
    blocks = [f"### {family.title}"] if heading else []
    if len(findings) == 1 and findings[0].contrast.theirs is not None:
        (one,) = findings
        rows = by_condition(one.contrast, study.results)
        blocks.append(tables.condition_table(rows, one.contrast, one, study.results))
        blocks.append(
            "Means with 95 % intervals over trainings and corridors, each alone. The first line is the test."
        )
    elif name != "lead":
        named = dict.fromkeys(place_beside(other, name)[1] for other in family.beside.values())
        notes = [study.families[own][0].note for own in named if own in study.families and own != name]
        blocks.append(" ".join((tables.family_note(family, findings), *notes)))
        blocks.append(_tests(study, name))
    else:
        blocks.append(tables.family_table(family, findings, {}))
    return "\n\n".join(block.strip("\n") for block in blocks)


def _tests(study: Study, name: str) -> str:
    """Return the table of a family's tests without the explanatory note."""
    family, findings = study.families[name]
    beside = {head: study.beside.get((other, name), {}) for head, other in family.beside.items()}
    return tables.family_table(family, findings, beside)


def _crossed(study: Study) -> tuple[Any, Any, tuple[str, str], np.ndarray]:
    crossed, names = crossed_tables(study.said, study.results), study.said["spread"]
    overall, each = factors(crossed)
    return overall, each, (names["rows"], names["columns"]), np.mean(list(crossed.values()), axis=0)


def _spread(study: Study, _: str) -> str:
    overall, each, names, _mean = _crossed(study)
    note = "The tests of the mean are one family, the tests of the single conditions another."
    return f"{note}\n\n{tables.spread_table(overall, each, names)}"


def _success(study: Study, _: str) -> str:
    results = study.results
    shown = [at for at in results.conditions if not _is_repeated(results, at)]
    head, lines = success_lines(study.summaries, results, shown)
    met = f" {FOUND_MET}" if results.met else ""
    note = f"Success [%] with 95 % intervals over trainings; of a single training over corridors.{met}"
    return f"{note}\n\n{markdown_table(head, lines, 2)}"


def _axes(study: Study, _: str) -> str:
    results = study.results
    lines = []
    for axis in list(results.axes)[1:]:  # without the nominal condition
        conditions = [at for at in results.conditions if at[0] == axis]
        pooled = {
            group: np.hstack([values_of(results.trainings(at, group), "success") for at in conditions])
            for group in results.groups
        }
        lines.append((axis, *(percent_text(rate_estimate(own)) for own in pooled.values())))
    note = (
        "Success [%] in all conditions of an axis together, with 95 % intervals over trainings; of a single "
        "training over episodes."
    )
    return f"{note}\n\n{markdown_table(('Axis', *results.groups), lines, 1)}"


def _is_repeated(results: Results, at: Condition) -> bool:
    """Whether a condition repeats the episodes of an earlier condition with the same simulation."""
    first = results.same_as[at]
    groups = results.groups
    return first != at and all(
        content(results.trainings(at, group)) == content(results.trainings(first, group)) for group in groups
    )


def _changes(study: Study, _: str) -> str:
    tests = len(replicated(study.changes))
    note = (
        "Change of success [points] against no error, with 95 % intervals. Bold: certain among all "
        f"{tests} changes (Benjamini and Hochberg). {MET} A training of the group met as much of that kind."
    )
    return f"{note}\n\n{tables.change_table(study.changes, study.doses)}"


def _losses(study: Study, _: str) -> str:
    """Return the losses of each group that are certain for other trainings."""
    tests = len(replicated(study.changes))
    note = (
        f"Certain for other trainings, among all {tests} changes (Benjamini and Hochberg) [points]; in "
        "brackets, how many trainings certainly lose by themselves."
    )
    return f"{note}\n\n{tables.certain_losses_table(study.results, study.changes)}"


def _headline(study: Study, _: str) -> str:
    """Return success [%] of each group under the conditions of `headline`, the best mean first."""
    results, asked = study.results, study.said["headline"]
    shown: list[Condition] = [
        (axis, value_of(str(value))) for axis, values in asked.items() for value in values
    ]
    lines: list[tuple[float, tuple[str, ...]]] = []
    for group, seeds in results.groups.items():
        rates = {at: float(results.values(at, group).mean()) for at in shown if (at, group) in results.cells}
        cells = [f"{100 * rates[at]:.0f}{MET if (at, group) in results.met else ''}" if at in rates else "-"
                 for at in shown]  # fmt: skip
        count = "" if None in seeds else f" ({len(seeds)})"
        lines.append((float(np.mean(list(rates.values()) or [0.0])), (f"`{group}`{count}", *cells)))
    lines.sort(key=lambda line: -line[0])
    head = ("policy (trainings)", *map(condition_text, shown))
    return markdown_table(head, [cells for _, cells in lines], 1)


def _provenance(study: Study, _: str) -> str:
    """Return the provenance of the results; a simulation shared by several conditions counts once."""
    facts, results, name = study.results.facts, study.results, study.name
    different = {(group, content(trainings)): trainings for (_, group), trainings in results.cells.items()}
    count = sum(len(own) for trainings in different.values() for own in trainings.values())
    runs = sum(len(seeds) for seeds in results.groups.values())
    commits = ", ".join(commit[:7] for commit in facts["evaluated_at"])
    made = dict.fromkeys(f"on {one['date']}" for one in (*facts.get("earlier", ()), facts))
    files = {
        "episodes": "episodes.csv.gz", "runs": "trainings.csv", "estimates": "estimates.csv",
        "changes": "changes.csv", "tests": "tests.csv", "commands and event errors": "about.json",
    }  # fmt: skip
    links = ", ".join(f"[{what}](data/{name}_{file})" for what, file in files.items())
    return (
        f"Made {', '.join(made)}, evaluated at commit {commits}: {runs} runs, "
        f"{facts['trials']} corridors, {count:,} episodes, actions {facts['action']}. Data: {links}."
    )


PARTS: dict[str, Callable[[Study, str], str]] = {
    "results": _results,
    "summary": _summary,
    "figure": _figure,
    "family": _family,
    "tests": _tests,
    "spread": _spread,
    "success": _success,
    "axes": _axes,
    "changes": _changes,
    "losses": _losses,
    "headline": _headline,
    "provenance": _provenance,
}
