"""A certificate as page: HTML and, from the same template, PDF/A-3b in which the XML is embedded."""

from __future__ import annotations

import hashlib
import io
import os
import re
import warnings
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

from ...adjust.uncertainty import UncertaintyBudget
from ...core.errors import FormatError, UsageError
from ...core.numbers import power
from ...core.optional import optional
from ...core.version import __version__
from .certificate import Certificate

NAME = "dcc.xml"
# Correlations of more parameters do not fit the width of a page; they are in the XML.
_WIDEST = 12
# What may be in the catalog besides the pages; scripts, forms and layers may not.
_CATALOG = {
    "/Type", "/Pages", "/Metadata", "/OutputIntents", "/Names", "/AF", "/Lang", "/MarkInfo",
    "/StructTreeRoot", "/ViewerPreferences", "/Outlines", "/Version", "/Extensions", "/PageLabels",
    "/PageMode",
}  # fmt: skip
_FAMILY, _MONO, _VARIANT = "DejaVu Serif", "DejaVu Sans Mono", "pdf/a-3b"


def html_of(certificate: Certificate) -> str:
    """Return the certificate as HTML page, without external resources.

    Examples
    --------
    >>> from reseau.service.certificates.certificate import example_certificate
    >>> "Institute of Photogrammetry" in html_of(example_certificate())
    True
    """
    from ...report.template import rendered  # brings matplotlib

    made, found = certificate, certificate.parameters
    probability, at = made.probability, made.places
    return rendered(
        "certificate.html.j2",
        title="Calibration certificate",
        made=made,
        data=made.data,
        percent=f"{100 * probability:g}",
        parameters=_rows(found, probability),
        held=[
            (name, f"{q.value:.7g}", _unit(q.unit))
            for name, q in made.calibration.parameters.items()
            if name not in found.names
        ],
        directions=[] if made.directions is None else _rows(made.directions, probability),
        places=[] if at is None else list(zip(at.names, at.xy.tolist(), strict=True)),
        sources=[
            (each.name, source, "∞" if np.isinf(each.degrees) else f"{each.degrees:g}", each.distribution,
             _shares(u, found.sigma))
            for each, source, u in zip(
                found.contributions, made.uncertainty.sources, found.by_contribution, strict=True
            )
        ],
        total=[f"{u:.2g}" for u in found.sigma],
        correlations=_correlations(found),
        joint=f"{found.joint_factor(probability):.3f}",
        joint_degrees=_degrees(found.joint_degrees),
        software=f"reseau {__version__}",
    )  # fmt: skip


def _rows(budget: UncertaintyBudget, probability: float) -> list[dict[str, Any]]:
    columns = zip(
        budget.names, budget.values, budget.sigma, budget.expanded(probability), budget.factor(probability),
        budget.degrees, budget.units, strict=True,
    )  # fmt: skip
    return [
        {
            "name": name, "value": power(float(value), float(expanded)), "sigma": f"{u:.2g}",
            "factor": f"{k:.2f}", "degrees": _degrees(float(nu)), "unit": _unit(unit),
        }
        for name, value, u, expanded, k, nu, unit in columns
    ]  # fmt: skip


def _unit(unit: str) -> str:
    """A unit as printed: mm⁻² for mm^-2."""
    raised = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    return re.sub(r"\^(-?\d+)", lambda found: found[1].translate(raised), "" if unit == "1" else unit)


def _degrees(nu: float) -> str:
    return "∞" if not np.isfinite(nu) or nu >= 1e5 else f"{nu:.0f}"


def _shares(u: Any, total: Any) -> list[str]:
    """Parts of the variances, in percent."""
    return [f"{100 * (a / b) ** 2:.1f}" if b > 0 else "–" for a, b in zip(u, total, strict=True)]


def _correlations(budget: UncertaintyBudget) -> list[tuple[str, list[str]]]:
    if len(budget.names) > _WIDEST:
        return []
    sigma = np.where(budget.sigma > 0, budget.sigma, 1.0)
    matrix = budget.covariance / np.outer(sigma, sigma)
    return [
        (name, [f"{matrix[i, j]:+.2f}".replace("-", "−") if j < i else "" for j in range(i)])
        for i, name in enumerate(budget.names)
    ]


def pdf_of(certificate: Certificate, xml: Callable[[str], bytes]) -> tuple[bytes, bytes]:
    """Return the certificate as PDF with its XML, and the XML.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    xml : callable
        Makes the XML, signed or not, with the digest of the pages.

    Notes
    -----
    The XML states the digest of the pages, so that its signature covers them too. The document is
    written as PDF/A-3b by WeasyPrint; its conformance was not examined by a validator.

    Raises
    ------
    UsageError
        If WeasyPrint, its library Pango, or pypdf is missing.

    Examples
    --------
    >>> from reseau.service.certificates.dcc import dcc_of
    >>> from reseau.service.certificates.certificate import example_certificate
    >>> made = example_certificate()
    >>> pdf_of(made, lambda pages: dcc_of(made, pages))[0][:5]  # doctest: +SKIP
    b'%PDF-'
    """
    try:
        with optional():
            import pypdf  # noqa: F401
            import weasyprint
            from weasyprint.text.fonts import FontConfiguration
    except OSError as error:
        raise UsageError(f"needs the library Pango ({error})", where="PDF", do="install libpango") from None
    page = weasyprint.HTML(string=html_of(certificate), url_fetcher=_no_resource)
    fonts = FontConfiguration()
    style = weasyprint.CSS(string=_style(), font_config=fonts)
    document = page.render(stylesheets=[style], font_config=fonts, pdf_variant=_VARIANT)
    content = xml(pages_digest(_written(document, certificate), "certificate"))
    document.metadata.attachments = [
        weasyprint.Attachment(
            string=content, name=NAME, description="Digital calibration certificate (DCC 3.3.0)",
            relationship="Alternative", created=_time(certificate), modified=_time(certificate),
        )
    ]  # fmt: skip
    return _written(document, certificate), content


def contents_of(
    certificate: Certificate, forms: Collection[str], key: Path | None = None, signer: Path | None = None
) -> dict[str, bytes]:
    """Return a certificate in several forms.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    forms : collection of {"pdf", "xml", "html"}
        Its forms; the XML, also that in the PDF, is a DCC.
    key, signer : Path, optional
        Private key and certificate, PEM, with which the XML is signed; the password of the key is in
        RESEAU_KEY_PASSWORD. By default it is not signed.

    Raises
    ------
    UsageError
        As :func:`pdf_of` and :func:`reseau.service.certificates.signature.sign`.

    Examples
    --------
    >>> from reseau.service.certificates.certificate import example_certificate
    >>> sorted(contents_of(example_certificate(), ["html"]))
    ['html']
    """

    def xml(pages: str = "") -> bytes:
        with optional():
            from .dcc import dcc_of
            from .signature import sign

        content = dcc_of(certificate, pages)
        if key is None or signer is None:
            return content
        return sign(content, key, signer, os.environ.get("RESEAU_KEY_PASSWORD"))

    found: dict[str, bytes] = {}
    if "pdf" in forms:
        found["pdf"], found["xml"] = pdf_of(certificate, xml)
    elif "xml" in forms:
        found["xml"] = xml()
    if "html" in forms:
        found["html"] = html_of(certificate).encode("utf-8")
    return found


def _written(document: Any, certificate: Certificate) -> bytes:
    before = os.environ.get("SOURCE_DATE_EPOCH")
    # Without HarfBuzz-Subset, fontTools makes the subsets of fonts, and writes the time into each.
    os.environ["SOURCE_DATE_EPOCH"] = str(int(_time(certificate).timestamp()))
    try:
        with warnings.catch_warnings():
            # WeasyPrint leaves the file of the colour profile to the garbage collector.
            warnings.simplefilter("ignore", ResourceWarning)
            found: bytes = document.write_pdf(pdf_variant=_VARIANT)
    finally:
        if before is None:
            del os.environ["SOURCE_DATE_EPOCH"]
        else:
            os.environ["SOURCE_DATE_EPOCH"] = before
    return found


def _style() -> str:
    """Style of the printed pages, with the fonts of matplotlib: a machine may have none."""
    import matplotlib

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    faces = [
        (_FAMILY, "", "normal", "normal"), (_FAMILY, "-Bold", "bold", "normal"),
        (_FAMILY, "-Italic", "normal", "italic"), (_FAMILY, "-BoldItalic", "bold", "italic"),
        (_MONO, "", "normal", "normal"),
    ]  # fmt: skip
    declared = [
        f'@font-face {{ font-family: "{family}"; font-weight: {weight}; font-style: {slant}; '
        f'src: url("{(folder / (family.replace(" ", "") + suffix + ".ttf")).as_uri()}"); }}'
        for family, suffix, weight, slant in faces
    ]
    return (
        "\n".join(declared)
        + f"""
body {{ font-family: "{_FAMILY}", serif; }}
code {{ font-family: "{_MONO}", monospace; }}
table {{ min-width: 120mm; }}
caption {{ padding-top: 1.6rem; }}
@page {{ size: A4; margin: 16mm 14mm 18mm;
  @bottom-left {{ content: string(identifier); font: 8pt "{_FAMILY}", serif; }}
  @bottom-right {{ content: counter(page) " / " counter(pages); font: 8pt "{_FAMILY}", serif; }} }}
dl.first dd:first-of-type {{ string-set: identifier content(); }}
"""
    )


def _time(certificate: Certificate) -> Any:
    """The date of issue, so that the same certificate has the same bytes."""
    from datetime import UTC, datetime, time

    return datetime.combine(certificate.issued, time(), UTC)


def _no_resource(url: str, *_: Any, **__: Any) -> Any:
    raise ValueError(f"a certificate has no external resources: {url}")


def attached(pdf: bytes, where: object) -> bytes:
    """Return the certificate that is embedded in a PDF.

    Raises
    ------
    FormatError
        If the PDF is damaged or has none, or several.
    """
    reader = _reader(pdf, where)
    try:
        found = [data for name, each in reader.attachments.items() if name == NAME for data in each]
    except Exception as error:  # pypdf raises many kinds for damaged files
        raise FormatError(f"is a damaged PDF ({error})", where=where) from None
    if len(found) != 1:
        raise FormatError(f"has {len(found)} embedded certificates named {NAME}", where=where)
    return bytes(found[0])


def pages_digest(pdf: bytes, where: object) -> str:
    """SHA-256 of everything that determines how the pages of a PDF look.

    Raises
    ------
    FormatError
        If the PDF is damaged, or has forms, scripts or layers.
    """
    reader = _reader(pdf, where)
    digest, seen = hashlib.sha256(), dict[tuple[int, int], int]()
    try:
        more = sorted(set(reader.trailer["/Root"].keys()) - _CATALOG)
        if more:
            raise FormatError(f"has {more[0]}, which a certificate does not have", where=where)
        for page in reader.pages:
            _hash(page, digest, seen, inherited=True)
    except FormatError:
        raise
    except Exception as error:
        raise FormatError(f"is a damaged PDF ({error})", where=where) from None
    return digest.hexdigest()


def _reader(pdf: bytes, where: object) -> Any:
    with optional():
        import pypdf
    try:
        return pypdf.PdfReader(io.BytesIO(pdf), strict=True)
    except Exception as error:
        raise FormatError(f"is a damaged PDF ({error})", where=where) from None


def _hash(item: Any, digest: Any, seen: dict[tuple[int, int], int], *, inherited: bool = False) -> None:
    """Hash an object with all that it refers to; references by their order, streams by their content."""
    from pypdf.generic import ArrayObject, DictionaryObject, IndirectObject, StreamObject

    if isinstance(item, IndirectObject):
        key = (item.idnum, item.generation)
        if key in seen:
            digest.update(f"again {seen[key]};".encode())
            return
        seen[key] = len(seen)
        item = item.get_object()
    if isinstance(item, DictionaryObject):
        content = item.get_data() if isinstance(item, StreamObject) else None
        left_out = {"/Parent", "/Length", "/Filter", "/DecodeParms", "/StructParents", "/StructParent"}
        digest.update(b"<<")
        for name in sorted(set(item.keys()) - left_out):
            digest.update(name.encode("utf-8"))
            _hash(item.raw_get(name), digest, seen)
        if inherited:  # what a page takes from the tree of pages
            for name in ("/Resources", "/MediaBox", "/CropBox", "/Rotate"):
                parent = item.get("/Parent")
                while name not in item and parent is not None:
                    parent = parent.get_object()
                    if name in parent:
                        digest.update(name.encode("utf-8"))
                        _hash(parent.raw_get(name), digest, seen)
                        break
                    parent = parent.get("/Parent")
        if content is not None:
            digest.update(hashlib.sha256(content).digest())
        digest.update(b">>")
    elif isinstance(item, ArrayObject):
        digest.update(b"[")
        for each in list.__iter__(item):
            _hash(each, digest, seen)
        digest.update(b"]")
    else:
        digest.update(f"{type(item).__name__} {item!r};".encode())
