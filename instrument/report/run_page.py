"""The page of a run: plan, what the stages show, checks, what each stage cost and how wrong it may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from instrument.report.page import Block, Card, Cell, Details, Page, Section, Table, Text, duration, number
from instrument.units import si_prefix


def page_of_run(
    record: Mapping[str, Any],
    cards: Sequence[Card] = (),
    sections: Sequence[Section] = (),
    tables: Sequence[Section] = (),
) -> Page:
    """The page of a run from what `run.json` holds; a part that is absent there is absent here.

    `cards`, `sections` and long `tables` are those of the stages. Read are name, title, finished, seed, versions,
    machine, plan (text, engine), stages, memory, parts, checks, and where given command, kind ("scene" unless said) and
    stage_errors (stage -> how wrong it may be).
    """
    plan = record.get("plan", {})
    sections = [
        *sections,
        Section("Checks", _checks(record)),
        Section("What each stage cost, and how wrong it may be", _stages(record)),
        Section("Plan", [Text("\n".join(plan.get("text", ())), code=True)] if plan.get("text") else []),
        *tables,
        Section("To run it again", _again(record)),
    ]
    finished = record.get("finished", "").replace("T", " ").replace("+00:00", " UTC")
    verdicts = {name: check.get("passed", True) for name, check in record.get("checks", {}).items()}
    short = [name for name, passed in verdicts.items() if passed is False]
    unmade = [name for name, passed in verdicts.items() if passed is None]
    verdict = f"Done, but fell short: {', '.join(short)}." if short else "Done; every check held."
    if unmade and not short:
        verdict = f"Done; not checked: {', '.join(unmade)}."
    if not verdicts:
        verdict = "Done; nothing was checked."
    return Page(
        title=record.get("title") or record.get("name", "run"),
        subtitle=f"{record.get('kind', 'scene')} {record.get('name', '')}, finished {finished}",
        verdict=verdict,
        mark="bad" if short else "good" if verdicts and not unmade else "",
        cards=[*cards, *_cards(record)],
        sections=[section for section in sections if section.blocks],
        footer=f"instrument {record.get('versions', {}).get('instrument', '')}",
    )


def _mark(passed: bool | None, good: str = "held", bad: str = "fell short") -> Cell | str:
    """The verdict of a check; one that was not made, `None`, is neither held nor fell short."""
    if passed is None:
        return "not checked"
    return Cell(good if passed else bad, mark="good" if passed else "bad")


def _cards(record: Mapping[str, Any]) -> list[Card]:
    cards = []
    checks = record.get("checks", {})
    if (check := checks.get("prediction")) and check.get("passed") is not None:
        note = f"of the {number(check['relative_to_jy'], 4)} Jy in the sky; bound {check['bound']:.1e}"
        cards.append(Card("Prediction error", f"{check['error']:.1e}", note, "good" if check["passed"] else "bad"))
    if steps := record.get("stages"):
        seconds = [step["seconds"]["measured"] for step in steps.values()]
        parts = [record.get("plan", {}).get("engine"), record.get("machine", {}).get("workers")]
        workers = f"{parts[1]} worker{'' if parts[1] == 1 else 's'}"
        cards.append(Card("Wall time", duration(sum(seconds)), f"engine {parts[0]}, {workers}" if all(parts) else ""))
    return cards


def _checks(record: Mapping[str, Any]) -> list[Block]:
    rows: list[list[Any]] = []
    for name, check in record.get("checks", {}).items():
        if name == "prediction" and check.get("passed") is None:
            found, wanted = check.get("text", ""), ""
        elif name == "prediction":
            found, wanted = f"error {check['error']:.1e}", f"at most {check['bound']:.1e}"
            seen = ", ".join(f"{n} {of}/{all_}" for n, (of, all_) in check.get("seen", {}).items())
            name = f"prediction, {check['samples']} visibilities against the definition" + (seen and f" ({seen})")
        else:
            found, wanted = _found_and_wanted(name, "; ".join(dict.fromkeys(check.get("outcome", ()))))
        rows.append([name, found, wanted, _mark(check.get("passed", True))])
        if "flux_in_jy" in check:
            given, seen = check["flux_in_jy"], check["flux_out_jy"]
            share = f"apparent, {number(100 * seen / given)}\u00a0%" if given else "apparent"
            rows.append(
                ["flux of all sources", f"{number(seen, 4)} Jy {share}", f"{number(given, 4)} Jy in the sky", ""]
            )
    return [Table(["check", "found", "expected", "verdict"], rows, stack=True)] if rows else []


def _found_and_wanted(name: str, text: str) -> tuple[str, str]:
    """The two halves of what a check says: what was found, and what it may be."""
    found, comma, most = text.partition(", at most ")
    if comma:
        most, comma, rest = most.partition(",")
        return found + comma + rest, f"at most {most}"
    wanted = {"removal": "converged, and no worse than before", "RM-CLEAN": "every spectrum done"}
    return text, wanted.get(name, "converged") if text not in ("", "not made") else ""


def _stages(record: Mapping[str, Any]) -> list[Block]:
    steps, checks = record.get("stages", {}), record.get("checks", {})
    if not steps:
        return []
    wrong = dict(record.get("stage_errors", {}))
    if (check := checks.get("prediction")) and check.get("passed") is not None:
        wrong.setdefault("predict", f"{check['error']:.1e} measured, {check['bound']:.1e} at most, of the total flux")
    if check := checks.get("photometry"):
        wrong.setdefault("photometry", "; ".join(dict.fromkeys(check["outcome"])))
    if summary := record.get("calibration", {}).get("summary"):
        wrong.setdefault("calibrate", summary)
    if check := checks.get("solutions"):
        wrong.setdefault("calibrate", "; ".join(check["outcome"]))
    for name in ("plan", "verify"):
        wrong.setdefault(name, "changes nothing")
    took = {name: step["seconds"]["measured"] for name, step in steps.items()}
    longest, parts = max(took.values()) or 1.0, record.get("parts", {})
    rows: list[list[Any]] = []
    for name, spent in sorted(took.items(), key=lambda item: -item[1]):
        inside = parts.get(name, {})
        own = wrong.get(name) or ("" if any(wrong.get(part) for part in inside) else "–")
        due, memory = steps[name]["seconds"]["planned"], steps[name]["memory"]
        bar = Cell(duration(spent), bar=spent / longest)
        planned = "–" if due is None else duration(due)
        rows.append([name, bar, planned, _bytes(memory["measured_bytes"]), _bytes(memory["planned_bytes"]), own])
        for part, t in sorted(inside.items(), key=lambda item: -item[1]):
            label = f"\u2003{part}".replace(" ", "\u00a0")
            rows.append([label, Cell(duration(t), bar=t / longest), "", "", "", wrong.get(part, "")])
    heads = ["stage", "time", "time planned", "memory", "memory planned", "how wrong it may be"]
    blocks: list[Block] = [Table(heads, rows, stack=True)]
    if (memory := record.get("memory")) and memory["planned_bytes"]:
        blocks.append(
            Text(
                f"Memory of a stage: by how much it raised the most that the process has had. In the whole "
                f"{_bytes(memory['measured_bytes'])} at most, {_bytes(memory['planned_bytes'])} planned, the "
                "interpreter's own among them."
            )
        )
    return blocks


def _bytes(value: float | None) -> str:
    return "–" if not value else si_prefix(value, "B")


def _again(record: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = [Text(record.get("command", "instrument run scene.toml"), code=True)]
    rows = [["seed", number(record.get("seed"))]]
    rows += [[name, str(value)] for name, value in record.get("machine", {}).items()]
    rows += [[name, str(value)] for name, value in record.get("versions", {}).items()]
    return [Details("Command, seed, versions", [*blocks, Table(["what", "value"], rows)])]
