"""Certificates: budgets, traceability, DCC against schema and rules, signatures, pages, changed documents."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
from collections.abc import Callable
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.adjust.uncertainty import validate
from reseau.archive import Archive
from reseau.calibration import Calibration
from reseau.calibration.assessment import Assessment, Use
from reseau.cli import run
from reseau.core.data import ImagePoints
from reseau.core.errors import FormatError, UsageError
from reseau.service import Configurations
from reseau.service.certificates import CertificateData, certify, html_of, measurement_budget, verify
from reseau.service.certificates.budget import simulate_measurement, uncertainty_of
from reseau.service.certificates.certificate import Certificate
from reseau.service.certificates.dcc import dcc_of, digital_unit
from reseau.service.certificates.page import pdf_of
from reseau.service.certificates.signature import sign

from .test_inforce import RULES, SIGMA, camera, started

etree = pytest.importorskip("lxml.etree")
pytest.importorskip("saxonche")
pytest.importorskip("xmlsec")
pypdf = pytest.importorskip("pypdf")
try:
    import weasyprint
except (ImportError, OSError):  # the package, or its library Pango
    weasyprint = None

BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)
ISSUED = date(2026, 3, 29)
SI = "{https://ptb.de/si}"
LAB = {"name": "Institute of Photogrammetry", "city": "Bonn", "country": "DE", "email": "lab@example.org"}
BARE: dict[str, Any] = {
    "schema": "reseau-certificate-data/1",
    "laboratory": LAB,
    "customer": {"name": "Kunde & Söhne <GmbH>", "city": "Wien", "country": "AT"},
    "responsible": ["Ada Byron"],
    "item": {"name": "camera", "manufacturer": "TIS", "serial": "4711"},
}
FULL = BARE | {
    "standards": [
        {
            "name": "scale bar", "kind": "bar", "identification": "SB-1",
            "certificate": {"issuer": "PTB", "id": "5.4-1234", "sha256": "ab" * 32},
        }
    ],
    "temperature": {"celsius": 20.4, "sigma": 0.3, "coefficients": {"c": 1.2e-4}},
    "contributions": [
        {"name": "scale of the target", "kind": "target coordinates", "sigma": 1e-5,
         "sensitivities": {"c": 8.0}, "distribution": "rectangular"}
    ],
    "remarks": ["Aperture f/8."],
}  # fmt: skip


VERDICT = Assessment(use=Use.MEASUREMENT, lines=(), centre_px=0.004, corners_px=0.02)


def calibration(**values: float) -> Calibration:
    made = camera(begun=BEGUN, **values)
    more = {
        "sigma_between_images": {"c": 1.5e-4, "x0": 1.2e-4, "y0": 0.9e-4, "K1": 2.2e-6},
        "images": 12,
    }
    return made.model_copy(update={"validity": made.validity | more, "assessment": VERDICT})


def certificate(data: dict[str, Any] = FULL, **options: Any) -> Certificate:
    given = CertificateData.parse(json.dumps(data), where="data")
    return certify(calibration(), given, issued=ISSUED, **options)


@pytest.fixture(scope="module")
def signer(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, Path]]:
    """Key and certificate by the name of an algorithm."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the keys, is not installed")
    folder = tmp_path_factory.mktemp("keys")
    kinds = {"rsa": ["rsa:2048"], "ec": ["ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]}

    def make(kind: str) -> tuple[Path, Path]:
        key, pem = folder / f"{kind}.key", folder / f"{kind}.pem"
        if not key.exists():
            subprocess.run(
                ["openssl", "req", "-x509", "-newkey", *kinds[kind], "-nodes", "-keyout", key, "-out", pem,
                 "-days", "2", "-subj", "/CN=signer"],
                check=True, capture_output=True,
            )  # fmt: skip
        return key, pem

    return make


def states(path: Path, **options: Any) -> dict[str, str]:
    return {each.check: each.state for each in verify(path, **options)}


def test_the_parts_of_the_uncertainty_are_their_closed_forms() -> None:
    """Temperature, model, scale and reproducibility, of independent parameters."""
    first = calibration()
    others = [calibration(c=8.0 + off) for off in (4e-4, -3e-4, 2e-4)]
    data = CertificateData.parse(json.dumps(FULL), where="data")
    found = uncertainty_of(first, others, data)
    budget = found.budget()
    of = dict(zip((each.name for each in budget.contributions), budget.by_contribution, strict=True))
    assert of["grey values"] == pytest.approx(list(SIGMA.values()), rel=1e-12)
    assert of["temperature"] == pytest.approx([0.3 * 1.2e-4, 0, 0, 0], rel=1e-12)
    assert of["scale of the target"] == pytest.approx([8e-5, 0, 0, 0], rel=1e-12)
    excess = np.sqrt([1.5e-4**2 - 1e-8, 1.2e-4**2 - 1e-8, 0.0, 2.2e-6**2 - 4e-12])
    assert of["model: scatter between images"] == pytest.approx(excess, rel=1e-9, abs=1e-15)
    between = np.sqrt(np.var([0, 4e-4, -3e-4, 2e-4], ddof=1) - 1e-8)
    assert of["reproducibility between sessions"] == pytest.approx([between, 0, 0, 0], rel=1e-9, abs=1e-12)
    u = np.array([part[0] for part in of.values()])
    nu = np.array([each.degrees for each in budget.contributions])
    assert budget.sigma[0] == pytest.approx(np.sqrt((u**2).sum()), rel=1e-12)
    assert budget.degrees[0] == pytest.approx((u**2).sum() ** 2 / (u**4 / nu).sum(), rel=1e-12)
    assert found.missing == {}


def test_a_measurement_carries_the_covariance_that_the_calibration_causes() -> None:
    """Each point as the mapping propagates it; the covariance between points is that of the parameters."""
    plain = camera(begun=BEGUN)
    points = ImagePoints.with_sigma(["a", "b"], [[100.0, 100.0], [600.0, 400.0]], 0.02)
    sources = uncertainty_of(plain)
    budget = measurement_budget(sources, points)
    alone = plain.mapping().apply(points)
    for k in range(2):
        own = slice(2 * k, 2 * k + 2)
        assert np.allclose(budget.covariance[own, own], alone.cov[k], rtol=1e-12, atol=0)
    _, _, by = plain.mapping().derivatives(points.xy)
    assert np.allclose(
        budget.covariance[:2, 2:], by[0] @ plain.matrix()[:4, :4] @ by[1].T, rtol=1e-12, atol=0
    )
    told = validate(budget, simulate_measurement(sources, points, draws=4000))
    assert set(told.verdicts) <= {"linear", "not decided"}
    assert (told.largest < 5 * told.error + told.tolerance).all()


def test_dcc_is_valid_against_schema_and_rules(reference_data: Callable[[str], Path], tmp_path: Path) -> None:
    schema = reference_data("dcc")
    for name, data in (("full", FULL), ("bare", BARE)):
        path = tmp_path / f"{name}.xml"
        path.write_bytes(dcc_of(certificate(data), "ab" * 32))
        verdicts = {each.check: each for each in verify(path, schema=schema)}
        assert {check for check, each in verdicts.items() if each.state == "passed"} == {
            "syntax", "schema", "rules", "numbers", "vocabulary"
        }, verdicts  # fmt: skip
        text = path.read_text("utf-8")
        for deprecated in (
            "expandedUnc",
            "coverageIntervalXMLList",
            "ellipsoidalRegionXMLList",
            "uncertaintyXMLList",
        ):
            assert f"<si:{deprecated}" not in text


def test_broken_examples_are_refused_each_for_its_reason(reference_data: Callable[[str], Path]) -> None:
    folder = reference_data("dcc")
    reasons = {"syntax": "mismatch", "schema": "uniqueIdentifier", "schematron": "declared languages",
               "signature": "changed after"}  # fmt: skip
    for kind, reason in reasons.items():
        found = verify(folder / "examples" / f"invalid_{kind}.xml", schema=folder)
        failed = [each for each in found if each.state == "failed"]
        assert [each.check for each in failed] == [{"schematron": "rules"}.get(kind, kind)]
        assert reason in failed[0].text
        if kind == "schematron":
            assert len(failed[0].more) == 68
    for name in ("valid.xml", "valid_signature.xml"):
        assert "failed" not in states(folder / "examples" / name, schema=folder).values()
    old = states(folder / "examples" / "dcc_gp_humidity_v1.0.xml", schema=folder)
    assert (old["schema"], old["rules"]) == ("failed", "failed")


def test_values_and_covariances_are_those_of_the_budget_in_si_units() -> None:
    made = certificate()
    root = etree.fromstring(dcc_of(made))
    vector = root.find(f".//{{https://ptb.de/dcc}}result[@refType='reseau_parameters']//{SI}realListXMLList")
    to_metres = np.array([1e-3, 1e-3, 1e-3, 1e6])  # the last is K1, in mm^-2
    values = np.array(vector.findtext(f"{SI}valueXMLList").split(), float)
    assert values == pytest.approx(made.parameters.values * to_metres, rel=1e-15)
    assert vector.findtext(f"{SI}unitXMLList") == "\\metre \\metre \\metre \\metre\\tothe{-2}"
    region = vector.find(f"{SI}measurementUncertaintyMultivariateXMLList/{SI}ellipsoidalRegionMUXMLList")
    columns = [
        [float(each.text) for each in column.iter(f"{SI}valueXMLList")]
        for column in region.iter(f"{SI}columnXMLList")
    ]
    expected = made.parameters.covariance * np.outer(to_metres, to_metres)
    assert np.allclose(columns, expected, rtol=1e-14, atol=0)
    exponents = np.add.outer([1, 1, 1, -2], [1, 1, 1, -2]).ravel()
    units = [each.text for each in region.iter(f"{SI}unitXMLList")]
    assert units == [f"\\metre\\tothe{{{n}}}" for n in exponents]
    factor = float(region.findtext(f"{SI}coverageFactorXMLList"))
    assert factor == pytest.approx(made.parameters.joint_factor(0.95), abs=1e-6)
    assert [digital_unit(u).number(0.1) for u in ("mm", "mm^-2", "px", "1", "%")] == [
        "0.0001", "1E+5", "0.1", "0.1", "0.001"
    ]  # fmt: skip
    with pytest.raises(UsageError, match="furlong"):
        digital_unit("furlong")


@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_signatures_verify_with_xmlsec1_and_changes_are_found(
    kind: str, signer: Callable[[str], tuple[Path, Path]], tmp_path: Path
) -> None:
    key, pem = signer(kind)
    other = signer("ec" if kind == "rsa" else "rsa")[1]
    path = tmp_path / "signed.xml"
    path.write_bytes(sign(dcc_of(certificate()), key, pem))
    assert states(path)["signature"] == states(path, trusted=[pem])["signature"] == "passed"
    assert states(path, trusted=[other])["signature"] == "failed"
    if shutil.which("xmlsec1"):
        done = subprocess.run(
            ["xmlsec1", "--verify", "--pubkey-cert-pem", pem, path], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
    text = path.read_text("utf-8")
    changed = tmp_path / "changed.xml"
    for before, after in (
        ("4711", "4712"),
        ("<si:value>", "<si:value>1"),
        ("Ada Byron", "Eve"),
        ("true", "false"),
    ):
        assert before in text
        changed.write_text(text.replace(before, after, 1), "utf-8")
        assert states(changed)["signature"] == "failed"
    with pytest.raises(UsageError, match="does not belong to the key"):
        sign(dcc_of(certificate()), key, other)


def test_signatures_that_hide_something_are_refused(
    signer: Callable[[str], tuple[Path, Path]], tmp_path: Path
) -> None:
    """Coverage of a part, a transform that selects, an algorithm without a secret, a signature elsewhere."""
    signed = sign(dcc_of(certificate()), *signer("rsa")).decode("utf-8")
    path = tmp_path / "changed.xml"
    for before, after, reason in (
        ('URI=""', 'URI="#a"', "whole document"),
        ("2001/10/xml-exc-c14n#", "TR/1999/REC-xslt-19991116", "can hide"),
        ("xmldsig-more#rsa-sha256", "xmldsig-more#hmac-sha256", "not accepted"),
        ("xmlenc#sha256", "xmldsig#sha1", "not accepted"),
    ):
        assert before in signed
        path.write_text(signed.replace(before, after), "utf-8")
        found = {each.check: each for each in verify(path)}["signature"]
        assert found.state == "failed"
        assert reason in found.text
    root = etree.fromstring(signed.encode("utf-8"))
    root[0].append(root[-1])
    path.write_bytes(etree.tostring(root))
    assert "end of the document" in {each.check: each for each in verify(path)}["signature"].text
    # A comment is not signed, and cuts a value for some programs.
    path.write_text(signed.replace("<si:value>2", "<si:value>2<!-- -->", 1), "utf-8")
    assert states(path) == {"syntax": "failed"}
    path.write_text('<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "utf-8")
    assert states(path) == {"syntax": "failed"}


def test_contradictions_of_unsigned_certificates_are_found(tmp_path: Path) -> None:
    text = dcc_of(certificate()).decode("utf-8")
    root = etree.fromstring(text.encode("utf-8"))
    first = root.find(f".//{SI}covarianceXMLList/{SI}valueXMLList").text
    path = tmp_path / "changed.xml"
    path.write_text(text.replace(f">{first}<", ">1E-20<", 1), "utf-8")
    assert states(path)["numbers"] == "failed"
    path.write_text(text.replace("reseau_scaleBar", "reseau_scalebar"), "utf-8")
    assert states(path)["vocabulary"] == "failed"


@pytest.mark.skipif(weasyprint is None, reason="WeasyPrint or its library Pango is not installed")
def test_pages_and_embedded_certificate_belong_together(
    signer: Callable[[str], tuple[Path, Path]], tmp_path: Path
) -> None:
    made = certificate(BARE)
    pdf, xml = pdf_of(made, lambda pages: sign(dcc_of(made, pages), *signer("rsa")))
    path = tmp_path / "certificate.pdf"
    path.write_bytes(pdf)
    assert {states(path)[check] for check in ("syntax", "signature", "numbers", "vocabulary", "pages")} == {
        "passed"
    }
    reader = pypdf.PdfReader(io.BytesIO(pdf))
    assert reader.attachments["dcc.xml"] == [xml]
    metadata = reader.trailer["/Root"]["/Metadata"].get_data().decode("utf-8")
    assert 'part="3"' in metadata or "<pdfaid:part>3<" in metadata
    first = " ".join(reader.pages[0].extract_text().split())
    assert first.startswith("Calibration certificate The scale of this calibration is not traceable")
    # The same pages with a bar over a line.
    writer = pypdf.PdfWriter(clone_from=io.BytesIO(pdf))
    page = writer.pages[0]
    content = page.get_contents()
    content.set_data(content.get_data() + b"\n0 0 200 20 re f\n")
    page[pypdf.generic.NameObject("/Contents")] = writer._add_object(content)
    writer.write(path)
    assert states(path)["pages"] == "failed"
    assert states(path)["signature"] == "passed"
    # A script.
    writer = pypdf.PdfWriter(clone_from=io.BytesIO(pdf))
    name = pypdf.generic.NameObject
    script = {name("/S"): name("/JavaScript"), name("/JS"): pypdf.generic.TextStringObject("app.alert(1)")}
    writer.root_object[name("/OpenAction")] = pypdf.generic.DictionaryObject(script)
    writer.write(path)
    with pytest.raises(FormatError, match="which a certificate does not have"):
        verify(path)
    path.write_bytes(pdf[:5000])
    with pytest.raises(FormatError, match="damaged PDF"):
        verify(path)


def test_traceability_and_what_is_missing_come_first() -> None:
    def told(data: dict[str, Any]) -> str:
        return html_of(certificate(data)).split("</header>")[0]

    assert "certificate 5.4-1234 of PTB" in told(FULL)
    assert "is not traceable" in told(BARE)
    uncertified = BARE | {"standards": [FULL["standards"][0] | {"certificate": None}]}
    assert "has no certificate: it is not traceable" in told(uncertified)
    assert "&lt;GmbH&gt;" in told(BARE)
    assert "temperature: it was not recorded" in html_of(certificate(BARE))
    first = etree.fromstring(dcc_of(certificate(uncertified))).find(".//{*}statement")
    assert first.findtext("{*}traceable") == "false"


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An archive with an accepted, a rejected and an undecided calibration, and their files."""
    monkeypatch.chdir(tmp_path)
    with Archive.open("archive", create=True) as archive:
        known, _ = started(archive)
        for name, new in (("accepted", calibration()), ("rejected", calibration(c=8.05))):
            made = known.decide("left", new, RULES)
            assert made.outcome.startswith(name)
            new.write(f"{name}.json")
        known.define("right", {"camera": "other"})
        known.decide("right", camera(c=7.9, begun=BEGUN), RULES)
        camera(c=7.9, begun=BEGUN).write("open.json")
    calibration(c=8.1).write("unknown.json")
    Path("data.json").write_text(json.dumps(FULL), "utf-8")
    Path("bad.json").write_text(json.dumps(BARE | {"responsible": []}), "utf-8")
    return tmp_path


def test_only_an_accepted_calibration_gets_a_certificate(
    opened: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--data", "data.json", "--issued", "2026-03-29", "--out", "c.xml"]
    create = ["certificate", "create"]
    with Archive.open("archive") as archive:
        rejected = Configurations(archive).history("left")[-1].key
    for source, said in (
        (["rejected.json", "-a", "archive"], "is rejected"),
        (["rejected.json", "-a", "archive", "--undecided"], "is rejected"),
        (["left", "-a", "archive", "--decision", rejected], "is rejected"),
        (["open.json", "-a", "archive"], "review it first"),
        (["unknown.json", "-a", "archive"], "was not decided on"),
        (["accepted.json"], "was not decided on"),
        (["right", "-a", "archive"], "has no calibration in force"),
        (["accepted.json", "-a", "archive", "--signing-key", "k.pem"], "must be given together"),
        (
            ["accepted.json", "-a", "archive", "--signing-key", "k.pem", "--signing-certificate", "c.pem"],
            "k.pem: cannot be",
        ),
        (["accepted.json", "-a", "archive", "--issued", "2026-01-01"], "not in this order"),
        (["accepted.json", "-a", "archive", "--probability", "0.2"], "coverage probability"),
        (["accepted.json", "-a", "archive", "--data", "bad.json"], "responsible"),
    ):  # fmt: skip
        assert run([*create, source[0], *options, *source[1:]]) in (1, 2), source
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
        assert not Path("c.xml").exists()
    assert run([*create, "left", *options, "-a", "archive", "--out", "c.html"]) == 0
    assert "accepted by rules 1" in capsys.readouterr().out
    assert run([*create, "unknown.json", *options, "--undecided"]) == 0
    assert "No rules of acceptance" in capsys.readouterr().out
    assert run(["certificate", "verify", "c.xml", "--without-schema"]) == 0
    assert "not signed" in capsys.readouterr().out
    assert run(["certificate", "verify", "c.xml"]) == 2
    assert "--schema" in capsys.readouterr().err
    assert run(["certificate", "verify", "c.html", "--without-schema"]) == 1
    assert run(["certificate", "verify", "c.xml", "--schema", "archive"]) == 2
    assert "has no dcc.xsd" in capsys.readouterr().err


def test_budgets_from_the_command_line(opened: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("points.csv").write_text("id,x,y,sx,sy\na,100,100,0.02,0.02\nb,600,400,0.02,0.02\n", "utf-8")
    assert (
        run(
            ["uncertainty", "accepted.json", "points.csv", "--data", "data.json", "--out", "u.json", "--json"]
        )
        == 0
    )
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(Path("u.json").read_text("utf-8"))
    assert printed["results"]["name"] == ["a.x", "a.y", "b.x", "b.y"]
    with Archive.open("archive") as archive:  # the third session of which the calibration was accepted
        Configurations(archive).decide("left", calibration(c=8.0003), RULES)
    assert run(["uncertainty", "left", "-a", "archive", "--draws", "4000"]) == 0
    told = capsys.readouterr().out
    assert "Monte Carlo, 4000 draws" in told
    assert "reproducibility between sessions" in told
    assert run(["calibrations", "event", "left", "lens changed", "--at", "2026-02-01T00:00Z"]) == 0
    assert run(["uncertainty", "accepted.json", "-a", "archive"]) == 0
    assert "reproducibility; needs 3 sessions" not in capsys.readouterr().out
    assert run(["uncertainty", "accepted.json", "--draws", "10"]) == 2
    assert "at least 4000 draws" in capsys.readouterr().err
