"""`reseau calibrations`: calibrations in force, decisions on new ones, history, drift."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..core import vocabulary as v
from ..core.errors import EstimationError, UsageError
from ..core.files import writable
from ..core.options import Option
from .common import Place, pairs_of, say, say_either, say_json
from .declared import Commands

if TYPE_CHECKING:
    from ..service import Configurations
    from ..service.decisions import Decision


app = Commands(help="Calibrations in force: decide, review, return, history, drift.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the configuration.")]
Key = Annotated[str, typer.Argument(metavar="KEY", help="Decision, by the start of its key; see `history`.")]


@contextmanager
def _opened(place: Place, *, create: bool = False) -> Iterator[Configurations]:
    from ..service import Configurations

    with place.open(create=create) as found:
        yield Configurations(found)


def time_of(text: str | None, option: str) -> datetime | None:
    """A time with its zone.

    Raises
    ------
    UsageError
        If it is not one.
    """
    if text is None:
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(f"{text!r} is not a time", where=option, do="use 2026-03-29T08:00Z") from None
    if time.tzinfo is None:
        raise UsageError(f"{text} has no time zone", where=option, do="add one, such as Z or +01:00")
    return time.astimezone(UTC)


@app.command()
def define(
    name: Name,
    part: Annotated[list[str], Option("Part, KEY=VALUE: camera, lens, settings, firmware.", letter="-p")],
    place: Place,
) -> None:
    """Define a configuration of an instrument."""
    parts = pairs_of(part, "--part", "KEY=VALUE")
    with _opened(place, create=True) as found:
        found.define(name, parts)
    say(f"{name}: {', '.join(f'{k} {v}' for k, v in parts.items())}\n")


@app.command()
def decide(
    name: Name,
    calibration: Annotated[Path, typer.Argument(help="New calibration, reseau-calibration/1.")],
    rules: v.Rules,
    place: Place,
    since: Annotated[v.Since | None, "Default: the time of its session, or now."] = None,
    session: Annotated[
        str | None, Option("Session of the archive from which it is, which is checked.", value="NAME")
    ] = None,
    by: v.By = "",
    comment: v.Comment = "",
    as_json: v.AsJson = False,
) -> None:
    """Judge a new calibration by rules, and put it in force if they accept it (exit status 0)."""
    from ..calibration import read_calibration
    from ..service import AcceptanceRules

    new, judged_by = read_calibration(calibration), AcceptanceRules.read(rules)
    with _opened(place) as found:
        made = found.decide(
            name, new, judged_by, since=time_of(since, "--since"), by=by, comment=comment, session=session
        )
    say_decision(made, as_json)
    raise typer.Exit(0 if made.outcome.startswith("accepted") else 1)


@app.command()
def review(
    name: Name,
    key: Key,
    outcome: Annotated[str, typer.Argument(metavar="accepted|rejected", help="Outcome of the review.")],
    comment: v.Comment,
    place: Place,
    by: v.By = "",
) -> None:
    """Decide on a calibration that needs a review."""
    with _opened(place) as found:
        # Another text is refused by `review`.
        made = found.review(name, key, outcome, by=by, comment=comment)  # type: ignore[arg-type]
    say_decision(made, False)


@app.command()
def comment(
    name: Name,
    key: Key,
    text: Annotated[str, typer.Argument(help="Text.")],
    place: Place,
    by: v.By = "",
) -> None:
    """Add a comment to a decision; the outcome stays as it is."""
    with _opened(place) as found:
        found.comment(name, key, text, by=by)


@app.command("return")
def return_(
    name: Name,
    key: Key,
    place: Place,
    since: v.Since | None = None,
    by: v.By = "",
    comment: v.Comment = "",
) -> None:
    """Return to an earlier accepted calibration."""
    with _opened(place) as found:
        applied = found.roll_back(name, key, since=time_of(since, "--since"), by=by, comment=comment)
    say(f"{name}: {applied.key} applies from {applied.since:%Y-%m-%d %H:%M:%S}Z\n")


@app.command()
def reference(
    name: Name,
    key: Key,
    comment: v.Comment,
    place: Place,
    by: v.By = "",
) -> None:
    """Let the drift of later calibrations count from an accepted one on. Default: the first one accepted."""
    with _opened(place) as found:
        found.set_reference(name, key, by=by, comment=comment)


@app.command()
def event(
    name: Name,
    what: Annotated[str, typer.Argument(help="What happened: lens changed, camera dropped.")],
    place: Place,
    at: v.At | None = None,
    by: v.By = "",
) -> None:
    """Note a service event: from then on no calibration applies, and a run is due at once."""
    with _opened(place) as found:
        found.event(name, what, at=time_of(at, "--at"), by=by)


@app.command()
def show(
    place: Place,
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Configuration. Default: all.")] = None,
    at: v.At | None = None,
    known: Annotated[str | None, Option("Use only what had been entered by this time.", value="TIME")] = None,
    out: v.Out | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Show the calibration that applies at a time; --out writes it."""
    time, entered = time_of(at, "--at") or datetime.now(UTC), time_of(known, "--known")
    if out is not None:
        writable(out, ".json")
        if name is None:
            raise UsageError("needs the name of a configuration", where="--out")
    rows: list[dict[str, Any]] = []
    with _opened(place) as found:
        for each in found.names() if name is None else [name]:
            applied = found.applied(each, time, entered)
            row: dict[str, Any] = {"name": each, "parts": found.parts(each), "calibration": None}
            if applied is not None:
                why = {"since": applied.since.isoformat(), "why": applied.why}
                row |= {"calibration": applied.key, **why}
                if out is not None:
                    applied.calibration.write(out)
            rows.append(row)
    lines = (
        f"{row['name']}: {row['calibration']} since {row['since'][:16]}Z, by {row['why']}"
        if row["calibration"]
        else f"{row['name']}: no calibration in force"
        for row in rows
    )
    say_either(as_json, {"schema": "reseau-in-force/1", "at": time, "configurations": rows}, lines)
    if out is not None and rows[0]["calibration"] is None:
        raise EstimationError(f"no calibration applies at {time:%Y-%m-%d %H:%M}Z", where=name)


@app.command()
def history(name: Name, place: Place, as_json: v.AsJson = False) -> None:
    """Show all decisions with their findings, reviews and comments, and the service events."""
    with _opened(place) as found:
        decisions, events = found.history(name), found.events(name)
    if as_json:
        said = [{"at": time, "what": what} for time, what in events]
        say_json({"schema": "reseau-history/1", "decisions": list(map(_row, decisions)), "events": said})
        return
    for each in decisions:
        say_decision(each, False)
    for time, what in events:
        say(f"{time:%Y-%m-%d %H:%M}Z  {what}\n")


def _row(made: Decision) -> dict[str, Any]:
    return vars(made) | {
        "judgement": made.judgement.to_dict(),
        "earlier": [{"by": by, "at": at, "judgement": judged.to_dict()} for by, at, judged in made.earlier],
    }


def say_decision(made: Decision, as_json: bool) -> None:
    """Print a decision with its findings, review and comments."""
    if as_json:
        say_json({"schema": "reseau-decision/1", **_row(made)})
        return
    by = f"by {made.by}, rules {made.judgement.rules['version']}"
    say(f"{made.key}  {made.since:%Y-%m-%d %H:%M}Z  {made.outcome}, {by}\n")
    for each in made.judgement.findings:
        say(f"  {each.level:<8} {each.text}\n")
    for who, at, judged in made.earlier:
        rules = judged.rules["version"]
        say(f"  {at:%Y-%m-%d %H:%M}Z {judged.outcome}, by {who}, rules {rules}\n")
    if made.session:
        say(f"  of the session {made.session}\n")
    if made.reviewed_by:
        say(f"  reviewed by {made.reviewed_by}: {made.review}\n")
    for who, text in (*([(made.by, made.comment)] if made.comment else []), *made.comments):
        say(f"  {who}: {text}\n")


@app.command()
def drift(
    name: Name,
    place: Place,
    rate: Annotated[float, Option("False alarms per year, of all charts.", least=0.001)] = 0.1,
    runs_per_year: Annotated[float, Option("Number of runs in a year.", least=1)] = 52.0,
    chart: Annotated[Literal["cusum", "ewma", "shewhart"], Option("Kind of the charts.")] = "cusum",
    covariates: v.Covariates | None = None,
    recorded: v.Recorded | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Chart all parameters and the field since the last service event; exit status 1 if one has drifted.

    With covariates, drift that they explain is distinguished from other drift.
    """
    from ..core.numbers import or_null
    from ..service import ChartOptions, CovariateTable

    options = ChartOptions(kind=chart, rate=rate, runs_per_year=runs_per_year)
    table = None if covariates is None else CovariateTable.read(covariates)
    with _opened(place) as found:
        if recorded:
            _one_source(covariates)
            table = found.recorded(name, recorded)
        made = found.drift(name, options, table)
    charts, last = made.charts, len(made.keys) - 1
    signals, verdicts = made.signals, made.verdicts
    rows = [
        {
            "parameter": parameter, "learning": bool(charts.learning[last, k]),
            "width": or_null(charts.width[last, k]), "score": or_null(charts.score[last, k]),
            "autocorrelation": or_null(charts.autocorrelation[last, k]),
            "upper": float(charts.upper[last, k]), "lower": float(charts.lower[last, k]),
        }
        for k, parameter in enumerate(made.names)
    ]  # fmt: skip
    if as_json:
        limits = vars(charts.limits) | {"limit": or_null(charts.limits.limit)}
        content = {
            "runs": last + 1,
            "conversion_px": made.conversion_px,
            "limits": limits,
            "charts": rows,
            "signals": signals,
        }
        if table is not None:
            content["verdicts"] = verdicts
        say_json({"schema": "reseau-drift/1", **content})
    else:
        say(f"{name}: {last + 1} calibrations since the last service event\n")
        if made.conversion_px:
            say(f"  other models were converted, with errors of at most {made.conversion_px:.2g} px\n")
        for row in rows:
            wide = "" if row["width"] is None else f", {row['width']:.2f} times as wide as when learned"
            state = f"learning{wide}" if row["learning"] else "in control"
            phi = charts.autocorrelation[last, made.names.index(row["parameter"])]
            if phi > options.autocorrelation:
                state = f"correlated, φ up to {phi:.2f}; {state}"
            state = "signals" if charts.alarm[last, made.names.index(row["parameter"])] else state
            say(f"  {row['parameter']:<20} {row['upper']:6.2f} {row['lower']:6.2f}  {state}\n")
        for each in signals:
            said = f"{each['direction']} of {each['parameter']}, probably from {each['since']} on"
            say(f"  {each['calibration']}: {said}\n")
        for each in verdicts:
            by = f" by {', '.join(table.values)}" if table and each["verdict"] == "explained" else ""
            say(f"  {each['calibration']}: {each['parameter']} {each['verdict']}{by}\n")
    remains = signals if table is None else [each for each in verdicts if each["verdict"] == "drift"]
    raise typer.Exit(1 if remains else 0)


def _one_source(covariates: Path | None) -> None:
    if covariates is not None:
        raise UsageError("cannot be given together with --covariates", where="--recorded", do="omit one")


@app.command()
def function(
    name: Name,
    out: Annotated[v.Out, "Here the function (.json)."],
    place: Place,
    covariates: v.Covariates | None = None,
    recorded: v.Recorded | None = None,
    degree: Annotated[int, Option("Degree of the polynomial.", least=1, most=2)] = 1,
) -> None:
    """Fit the calibrations since the last service event as a function of covariates.

    It is declined, with exit status 1, where the calibrations do not support it.
    """
    from ..core.failure import Failure
    from ..service import CovariateTable
    from ..service.covariates import FunctionOptions

    writable(out, ".json")
    if covariates is None and not recorded:
        raise UsageError("none were given", where="covariates", do="give --covariates or --recorded")
    with _opened(place) as opened:
        if covariates is None:
            table = opened.recorded(name, recorded or [])
        else:
            table = CovariateTable.read(covariates)
        if recorded:
            _one_source(covariates)
        found = opened.function(name, table, FunctionOptions(degree=2 if degree == 2 else 1))
    if isinstance(found, Failure):
        raise EstimationError(found.reason, where=name, do="collect more calibrations, or use a single one")
    found.write(out)
    ranges = ", ".join(f"{each.name} {each.low:g} to {each.high:g} {each.unit}" for each in found.covariates)
    say(f"{name}: {found.runs} calibrations as a function of {ranges}, p = {found.p:.2g}\n")


@app.command()
def at(
    source: Annotated[Path, typer.Argument(metavar="FUNCTION", help="reseau-calibration-function/1.")],
    covariate: Annotated[
        list[str],
        Option("NAME=VALUE, or NAME=VALUE±SIGMA.", letter="-c"),
    ],
    out: Annotated[v.Out, "Here the calibration (.json)."],
) -> None:
    """Write the calibration at given values of the covariates, with what their uncertainties add."""
    from ..service.covariates import CalibrationFunction

    writable(out, ".json")
    values, sigmas = {}, {}
    for key, text in pairs_of(covariate, "--covariate", "KEY=VALUE").items():
        value, sign, sigma = text.replace("+-", "±").partition("±")
        try:
            values[key] = float(value)
            if sign:
                sigmas[key] = float(sigma)
        except ValueError:
            raise UsageError(f"{text!r} is no value", where=key, do=f"use {key}=23.5±0.3") from None
    found = CalibrationFunction.read(source).at(sigmas, **values)
    found.write(out)
    say(f"{out}: {found.name} at {', '.join(f'{key} {value:g}' for key, value in values.items())}\n")
