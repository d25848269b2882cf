"""`reseau certificate`, `reseau uncertainty`: certificates of calibrations, and their uncertainty budgets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import writable
from ..core.options import Option
from .calibrations import time_of
from .common import Place, say, say_either, say_json
from .declared import Commands

if TYPE_CHECKING:
    from ..adjust.uncertainty import Simulated, UncertaintyBudget
    from ..calibration import Calibration
    from ..service.certificates import CertificateData
    from ..service.decisions import Decision


app = Commands(help="Certificates of calibrations: create, verify, vocabulary.")

Source = Annotated[
    str,
    typer.Argument(
        metavar="CALIBRATION|NAME",
        help="File of a calibration, or with --archive the name of a configuration.",
    ),
]


@dataclass(frozen=True)
class Decided:
    """A calibration of an archive, with the decision on it."""

    archive: Annotated[v.Archive | None, "Here with decisions and earlier calibrations."] = None
    objects: v.Objects | None = None
    at: v.At | None = None
    decision: v.Decision | None = None


class _Found(NamedTuple):
    """A calibration, the decision on it, and those of other sessions."""

    calibration: Calibration
    decision: Decision | None
    configuration: str
    earlier: list[Calibration]


def _find(source: str, place: Decided) -> _Found:
    """Read a calibration from a file or an archive, with what the archive knows of it.

    Raises
    ------
    UsageError
        If there is none.
    """
    from ..calibration import read_calibration

    file, archive, key = Path(source), place.archive, place.decision
    stored = read_calibration(file) if file.is_file() or archive is None else None
    if archive is None:
        assert stored is not None
        return _Found(stored, None, "", [])
    from ..service import Configurations

    with Place(archive, place.objects).open() as opened:
        known = Configurations(opened)
        if stored is None:
            name, time = source, time_of(place.at, "--at") or datetime.now(UTC)
            if key is None:
                applied = known.applied(name, time)
                if applied is None:
                    raise UsageError(f"has no calibration in force at {time:%Y-%m-%d %H:%M}Z", where=name)
                key = applied.key
            decision: Decision | None = known.decision(name, key)
            assert decision is not None
            calibration = known.calibration(name, decision.key)
        else:
            calibration, own = stored, stored.key
            decided = [(each, d) for each in known.names() for d in known.history(each) if d.key == own]
            # Any rejection counts, whatever another configuration says.
            decided.sort(key=lambda pair: pair[1].outcome.startswith("accepted"))
            name, decision = decided[0] if decided else ("", None)
        earlier = known.earlier(name, decision) if name and decision is not None else []
        return _Found(calibration, decision, name, earlier)


@app.command()
def create(
    source: Source,
    data: Annotated[v.Data, "Laboratory, item, standards."],
    out: Annotated[list[v.Out], "Repeatable: .pdf (with the XML embedded), .xml (DCC), .html."],
    place: Decided,
    signing_key: v.SigningKey | None = None,
    signing_certificate: v.SigningCertificate | None = None,
    issued: Annotated[
        str | None, Option("Date of issue, such as 2026-03-29. Default: today.", value="DATE")
    ] = None,
    probability: v.Probability = 0.95,
    undecided: Annotated[
        bool, Option("Also if nobody decided on the calibration; the certificate says so.")
    ] = False,
) -> None:
    """Create the certificate of a calibration.

    A calibration that was rejected, or still needs a review, gets none.
    """
    from ..io import write_whole
    from ..service.certificates import CertificateData, certify
    from ..service.certificates.page import contents_of

    kinds = [writable(each, ".pdf", ".xml", ".html").suffix.lower()[1:] for each in out]
    if len(set(kinds)) < len(kinds):
        raise UsageError("has two files of one kind", where="--out")
    if (signing_key is None) != (signing_certificate is None):
        raise UsageError("must be given together", where="--signing-key and --signing-certificate")
    given = CertificateData.read(data)
    found = _find(source, place)
    if found.decision is None and not undecided:
        where = f"calibration {found.calibration.name}"
        raise UsageError("was not decided on", where=where,
                         do="give the --archive in which it was accepted, or --undecided")  # fmt: skip
    made = certify(
        found.calibration, given, issued=_date(issued), decision=found.decision,
        configuration=found.configuration, earlier=found.earlier, probability=probability,
    )  # fmt: skip
    contents = contents_of(made, kinds, signing_key, signing_certificate)
    for path, kind in zip(out, kinds, strict=True):
        write_whole(path, contents[kind])
    say(f"{made.identifier}: {', '.join(str(each) for each in out)}\n")
    for line in made.traceability:
        say(f"  {line}\n")
    say(f"  {made.conformity}\n")
    if "pdf" in kinds:
        say("  written as PDF/A-3b; no validator has examined its conformance\n")
    for what, why in made.uncertainty.missing.items():
        say(f"  not included: {what}; {why}\n")


def _date(text: str | None) -> date:
    try:
        return datetime.now(UTC).date() if text is None else date.fromisoformat(text)
    except ValueError:
        raise UsageError(f"{text!r} is not a date", where="--issued", do="use 2026-03-29") from None


@app.command()
def verify(
    file: Annotated[Path, typer.Argument(help="Certificate: DCC (XML), or PDF in which it is embedded.")],
    schema: Annotated[
        Path | None,
        Option("Folder with dcc.xsd, what it includes, and dcc.sch, of PTB.", environment="RESEAU_DCC"),
    ] = None,
    without_schema: Annotated[bool, Option("Check neither the schema nor the rules.")] = False,
    trust: Annotated[
        list[Path] | None, Option("Certificate of a trusted signer (PEM); it must be signed then.")
    ] = None,
    as_json: v.AsJson = False,
) -> None:
    """Verify a certificate: syntax, schema, rules, signature, numbers, pages; exit status 1 if refused."""
    from ..service.certificates import verify as verified

    if schema is None and not without_schema:
        raise UsageError("needs the schema of PTB", where="verify", do="give --schema, or --without-schema")
    found = verified(file, schema=None if without_schema else schema, trusted=trust or ())
    refused = any(each.state == "failed" for each in found)
    lines = [f"{each.state:<12} {each.check:<11} {each.text}" for each in found]
    lines.append(f"{file}: {'refused' if refused else 'nothing is wrong'}")
    content = {"refused": refused, "checks": list(map(vars, found))}
    say_either(as_json, {"schema": "reseau-verification/1", **content}, lines)
    raise typer.Exit(1 if refused else 0)


@app.command()
def vocabulary(out: v.Out | None = None) -> None:
    """Write our vocabulary of reference types (refType) in digital certificates."""
    from ..io import write_whole
    from ..service.certificates.vocabulary import vocabulary_text

    if out is None:
        say(vocabulary_text())
    else:
        write_whole(writable(out), vocabulary_text())


def uncertainty(
    source: Source,
    place: Decided,
    points: Annotated[
        Path | None,
        typer.Argument(metavar="POINTS", help="Image coordinates measured with it. Default: its parameters."),
    ] = None,
    data: Annotated[v.Data | None, "Here temperature and further contributions."] = None,
    draws: Annotated[
        int, Option("Draws of Monte Carlo to compare with; at least 4000, or 0 for none.", least=0)
    ] = 0,
    digits: Annotated[
        int | None,
        Option(
            "Stop drawing when results are stable to so many digits; --draws is the most.", least=1, most=3
        ),
    ] = None,
    seed: v.Seed = 0,
    probability: v.Probability = 0.95,
    out: v.Out | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Show the uncertainty budget of a calibration, or of points measured with it.

    After the GUM: contributions, effective degrees of freedom, coverage factors, covariance; with --draws
    compared with Monte Carlo after its Supplements 1 and 2.
    """
    from ..adjust import simulate
    from ..core.provenance import canonical_json
    from ..io import write_whole
    from ..io.reading import read_measurement
    from ..service.certificates import CertificateData, measurement_budget
    from ..service.certificates.budget import simulate_measurement, uncertainty_of

    writable(out, ".json")
    given: CertificateData | None = None if data is None else CertificateData.read(data)
    found = _find(source, place)
    sources = uncertainty_of(found.calibration, found.earlier, given)
    simulated: Simulated | None = None
    if digits is not None and not draws:
        raise UsageError("needs --draws, the largest number of them", where="--digits")
    # What judges the budget must itself be five times as certain (JCGM 101, 8.2).
    drawing: dict[str, Any] = {
        "probability": probability, "draws": draws, "digits": digits, "part": 0.2, "seed": seed,
    }  # fmt: skip
    if points is None:
        budget = sources.budget()
        if draws:
            simulated = simulate(
                lambda x: x,
                budget.values,
                budget.contributions,
                **drawing,
            )
    else:
        measured = read_measurement(points).image_points()
        budget = measurement_budget(sources, measured)
        if draws:
            simulated = simulate_measurement(sources, measured, **drawing)
    document = _document(budget, probability, dict(sources.missing), simulated)
    if out is not None:
        write_whole(out, canonical_json(document))
    if as_json:
        say_json(document)
    else:
        _say_budget(budget, probability, simulated)
        for what, why in sources.missing.items():
            say(f"not included: {what}; {why}\n")


def _document(
    budget: UncertaintyBudget, probability: float, missing: dict[str, str], simulated: Simulated | None
) -> dict[str, Any]:
    from ..adjust.uncertainty import validate
    from ..core.numbers import or_null

    found: dict[str, Any] = {
        "schema": "reseau-uncertainty/1",
        "probability": probability,
        "results": {
            "name": list(budget.names), "unit": list(budget.units), "value": budget.values.tolist(),
            "sigma": budget.sigma.tolist(), "degrees": [or_null(v) for v in budget.degrees],
            "factor": budget.factor(probability).tolist(), "expanded": budget.expanded(probability).tolist(),
        },
        "covariance": budget.covariance.tolist(),
        "joint": {"degrees": or_null(budget.joint_degrees),
                  "factor": or_null(budget.joint_factor(probability))},
        "inputs": list(budget.inputs),
        "sensitivities": budget.sensitivities.tolist(),
        "contributions": [
            {"name": each.name, "degrees": or_null(each.degrees), "distribution": each.distribution,
             "group": each.group, "sigma": u.tolist()}
            for each, u in zip(budget.contributions, budget.by_contribution, strict=True)
        ],
        "missing": missing,
    }  # fmt: skip
    if simulated is not None:
        checked = validate(budget, simulated)
        found["monte_carlo"] = {
            "draws": simulated.draws, "lost": simulated.lost, "stable": simulated.stable,
            "mean": simulated.mean.tolist(),
            "sigma": simulated.sigma.tolist(), "low": simulated.low.tolist(), "high": simulated.high.tolist(),
            "covariance": simulated.covariance.tolist(), "joint_factor": simulated.joint_factor,
            "difference": {"low": checked.low.tolist(), "high": checked.high.tolist(),
                           "error": checked.error.tolist(), "tolerance": checked.tolerance.tolist(),
                           "joint_factor": checked.joint_factor},
            "verdict": list(checked.verdicts),
        }  # fmt: skip
    return found


def _say_budget(budget: UncertaintyBudget, probability: float, simulated: Simulated | None) -> None:
    from ..adjust.uncertainty import validate
    from ..core.numbers import measured

    columns = zip(
        budget.names, budget.units, budget.values, budget.expanded(probability), budget.sigma,
        budget.factor(probability), budget.degrees, strict=True,
    )  # fmt: skip
    say(f"expanded uncertainties, {100 * probability:g} %\n")
    for i, (name, unit, value, expanded, u, k, nu) in enumerate(columns):
        shown = measured(float(value), float(expanded), unit)
        degrees = "∞" if not math.isfinite(nu) else f"{nu:.0f}"
        say(f"{name:<8} {shown}  u {u:.2g}, k {k:.2f}, ν {degrees}\n")
        for each, part in zip(budget.contributions, budget.by_contribution[:, i], strict=True):
            if part > 0:
                say(f"    {100 * (part / u) ** 2:5.1f} %  {part:9.2g}  {each.name}\n")
    joint = budget.joint_factor(probability)
    say(f"all together: ellipsoid of the covariance with the factor {joint:.3f}\n")
    if simulated is not None:
        checked = validate(budget, simulated)
        stable = {None: "", True: ", stable", False: ", not stable yet"}[simulated.stable]
        say(f"Monte Carlo, {simulated.draws} draws{stable}: ends of the intervals minus those above\n")
        for name, low, high, error, verdict in zip(
            budget.names, checked.low, checked.high, checked.error, checked.verdicts, strict=True
        ):
            say(f"{name:<8} {low:+.1e}, {high:+.1e} (± {error:.0e}): {verdict}\n")
        say(f"factor of the ellipsoid: {checked.joint_factor:+.3f}\n")
