"""What everybody should read: verdict, what to do, what each effect is worth, what could not be told."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from uwb_tdoa_bias.effects.wording import listed, measured

from .entries import LEAST_WORTH, WORTH_DOING, by_anchor, certainty_in_words, doubt_in_words, for_people, undecided_in_words, worth_in_words
from .markup import bar, folded, listing, paragraphs, section, stacked, table
from .unclear import by_remedy, untold

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from uwb_tdoa_bias.effects import Effect
    from ..diagnose import Diagnosis
    from .entries import Entry
    from .verdict import Verdict

MANY = 3  # anchors that a sentence names with their values


def head(diagnosis: Diagnosis, verdict: Verdict) -> str:
    """Title and verdict."""
    names = ", ".join(flight.name for flight in diagnosis.flights)
    box = f'<div class="verdict {verdict.kind}">{paragraphs(verdict.sentences)}</div>'
    out = f"<h1>Diagnosis of {escape(names)}</h1>{box}"
    if diagnosis.before["pooled"].get("rmse_3d") is None:
        return out
    return out + paragraphs(
        [
            "The error is the distance between estimate and ground truth in the air, as root mean square (RMSE). "
            "The intervals come from drawing the blocks of 5 s of the judged flights again and again: they hold for "
            "flights like these."
        ],
        "note",
    )


def to_do(diagnosis: Diagnosis, found: Sequence[Entry]) -> str:
    """What to do in the hall, and how to let the filter do the rest. found : [Entry]."""
    added = [entry for entry in found if entry.added]
    urgent = [entry for entry in added if entry.matters and entry.advice]
    rest = [entry for entry in found if not entry.matters and entry.advice]
    nameless = [entry.title for entry in added if not entry.advice]
    parts = [listing([(_asked(entry), _known_with(entry)) for entry in urgent], ordered=True)]
    if not urgent:
        parts += paragraphs([f"Nothing that the position is known to gain {100.0 * WORTH_DOING:.1f} cm from."])
    if nameless:
        parts += paragraphs([f"Leave to effects.yaml what has no known cause in the hall: {'; '.join(nameless)}."])
    if rest:
        note = f"Nobody has seen the position gain {100.0 * WORTH_DOING:.1f} cm from taking it out of the measurements, or it cannot be taken out."
        parts.append(folded("Seen too, not worth a visit", paragraphs([note], "note"), listing([(_asked(entry), ()) for entry in rest])))
    return section("What to do in the hall", *parts, _apply(diagnosis.applying) if added and diagnosis.applying else "")


def _asked(entry: Entry) -> str:
    """Markup of its advice: sentences; values of more than MANY anchors as a table."""
    out = []
    for finding in entry.findings:
        anchors, advice = by_anchor(finding.effect), finding.effect.advice()
        if len(anchors) > MANY and advice:
            first, _, rest = advice[0].partition(": ")
            last = rest.rpartition("; ")[2].partition(". ")[2]
            out += [paragraphs([f"{first}.", *filter(None, [last]), *advice[1:]]), _of_anchors(finding.effect, anchors)]
        else:
            out.append(paragraphs(advice))
    return "".join(out)


def _of_anchors(effect: Effect, anchors: Mapping[int, Mapping[str, tuple[float, float | None]]]) -> str:
    """A table of values by anchor, lengths in cm."""
    unit, factor = ("cm", 100.0) if effect.unit == "m" else for_people(effect.unit)
    parts = sorted({part for values in anchors.values() for part in values})
    head = ("anchor", *(f"{part} [{unit}]".lstrip() for part in parts))
    cells = [[_cell(values.get(part), factor) for part in parts] for values in anchors.values()]
    note = paragraphs([f"What {effect.name} found; where nothing stands it could be chance."], "note")
    return note + table(head, [(anchor, *row) for anchor, row in zip(anchors, cells)], numbers=range(1, len(head)))


def _cell(found: tuple[float, float | None] | None, factor: float) -> str:
    """ "+12.3 ± 0.5" """
    if found is None:
        return ""
    value, std = found
    text = measured(factor * value, factor * std if std else None)
    return text if text.startswith("-") else f"+{text}"


def _known_with(entry: Entry) -> list[str]:
    """What has to be known with its advice: [sentence]."""
    worth = (
        []
        if entry.worth is None
        else [f"Worth {worth_in_words(entry)} of position{', together' * (len(entry.advice) > 1)}."]
    )
    doubt = " ".join(undecided_in_words(entry))
    return worth + ([f"Make sure first: this {doubt[0].lower()}{doubt[1:]}"] if doubt else [])


def _apply(applying: Iterable[tuple[str, str]]) -> str:
    lines = "".join(
        f"<dt><code>{escape(command)}</code></dt><dd class='note'>{escape(what)}</dd>" for command, what in applying
    )
    text = (
        "effects.yaml, beside this page, takes out what the model lacked, whether or not anything is done in the "
        "hall. Once something is set right there, fly and diagnose again: the file then takes out too much. Both "
        "nodes take the same file:"
    )
    return f"<h3>Apply effects.yaml</h3>{paragraphs([text])}<dl>{lines}</dl>"


def worth(diagnosis: Diagnosis, found: Sequence[Entry]) -> str:
    """What was found, and what each is worth in centimetres of position. found : [Entry]."""
    if not found:
        return ""
    largest = max((entry.worth or 0.0 for entry in found if entry.added), default=0.0)
    head = ("effect", "worth in position", "what else it could be")
    rows = [[_name(entry), _worth(entry, largest), _else(entry)] for entry in found]
    note = [
        "By how much the position error (3D RMSE) grows if this one alone is left out, each flight with effects "
        "fitted to the others, or every other 5 s of a single one. Effects that can stand in for each other are each worth less "
        "than both together: the figures need not add up to the gain of all."
        if diagnosis.reference.tells_errors
        else "Nobody knows what each is worth for the position: without ground truth there is no error to compare."
    ]
    return section("What each effect is worth", paragraphs(note, "note"), stacked(head, rows))


def _name(entry: Entry) -> str:
    effect = entry.findings[0].effect
    physics = effect.physics if entry.findings[0].declared else "structure that no effect of the catalogue explains"
    more = f"<br><small>{escape(entry.over_flights)}</small>" if entry.over_flights else ""
    return f"<b>{escape(entry.title)}</b><br><small>{escape(physics)}</small>{more}"


def _else(entry: Entry) -> str:
    return "<br>".join(map(escape, doubt_in_words(entry) or [certainty_in_words(entry)]))


def _worth(entry: Entry, largest: float) -> str:
    if entry.why_not:
        return f"not in effects.yaml: {escape(entry.why_not)}"
    if entry.worth is None:
        return "not known"
    drawn = bar(entry.worth / largest) if largest > 0.0 and entry.worth >= LEAST_WORTH else ""
    return f"{drawn}{escape(worth_in_words(entry))}"


def not_told(diagnosis: Diagnosis) -> str:
    """What could not be told, and what would."""
    items = untold(diagnosis)
    parts = [
        table(
            ("what would tell", "effects that could be there unseen"),
            [(told_by, listed(what)) for told_by, what in by_remedy(items).items()],
        )
        if by_remedy(items)
        else "<p>Every effect that is fitted shows in these flights, if it is there.</p>"
    ]
    every = [(item.effect, item.what or "all of it", item.told_by) for item in items if item.what or not item.harmless]
    parts.append(
        folded(
            "Every combination of parameters that leaves too little trace",
            paragraphs(["They were not fitted further than what is plausible anyway."], "note"),
            table(("effect", "parameters", "what would tell"), every),
        )
        if every
        else ""
    )
    return section("What could not be told", *parts)
