"""Verification of certificates: syntax, schema, rules, signature, numbers, vocabulary, pages."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...core.errors import FormatError, UsageError
from ...core.files import readable
from ...core.optional import optional
from .dcc import DCC, SI
from .page import attached, pages_digest
from .signature import DS, signatures
from .vocabulary import NAMESPACE, vocabulary

_SHOWN = 3
State = Literal["passed", "failed", "not checked"]


@dataclass(frozen=True)
class Verdict:
    """What one check found.

    Parameters
    ----------
    check : str
        Name of the check.
    state : {"passed", "failed", "not checked"}
        Its result.
    text : str
        The reason.
    more : tuple of str
        All reasons, where there are several.

    Examples
    --------
    >>> Verdict("syntax", "passed", "well-formed").state
    'passed'
    """

    check: str
    state: State
    text: str
    more: tuple[str, ...] = ()


def verify(path: Path, *, schema: Path | None = None, trusted: Sequence[Path] = ()) -> list[Verdict]:
    """Verify a certificate.

    Parameters
    ----------
    path : Path
        DCC as XML, or a PDF in which it is embedded.
    schema : Path, optional
        Folder with ``dcc.xsd``, what it includes, and ``dcc.sch``, as PTB publishes them; without it neither
        the schema nor the rules are checked.
    trusted : sequence of Path
        Certificates (PEM) of trusted signers; the document must then be signed by one of them.

    Raises
    ------
    InputError
        If a file cannot be read.
    UsageError
        If the folder has no schema.

    Examples
    --------
    >>> for each in verify(Path("camera.pdf"), trusted=[Path("certificate.pem")]):  # doctest: +SKIP
    ...     print(each.check, each.state, each.text)
    """
    with optional():
        from lxml import etree

    with readable(path):
        content = path.read_bytes()
    pdf = content if content.startswith(b"%PDF") else None
    xml = content if pdf is None else attached(pdf, path)
    found: list[Verdict] = []
    try:
        root = etree.fromstring(xml, etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False))
    except etree.XMLSyntaxError as error:
        return [Verdict("syntax", "failed", f"is not well-formed XML: {error}")]
    if root.getroottree().docinfo.doctype:
        return [Verdict("syntax", "failed", "has a document type, which a certificate must not have")]
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        return [Verdict("syntax", "failed", f"is no digital calibration certificate, but {root.tag}")]
    for each in root.iter(etree.Comment, etree.ProcessingInstruction):
        # A signature does not cover comments; within a value they change what programs read.
        if each.getparent() is not None and not len(each.getparent().findall("*")):
            return [Verdict("syntax", "failed", f"line {each.sourceline}: has a comment within a value")]
    found.append(Verdict("syntax", "passed", "well-formed"))
    if schema is None:
        found += [Verdict(name, "not checked", "no schema was given") for name in ("schema", "rules")]
    else:
        found += [_schema(etree, root, _file(schema, "dcc.xsd")), _rules(xml, _file(schema, "dcc.sch"))]
    found.append(_signatures(xml, root, trusted))
    found += [_numbers(root), _words(root)]
    if pdf is not None:
        found.append(_pages(root, pdf, path))
        text = "whether the file conforms to PDF/A is for a validator of its own, such as veraPDF"
        found.append(Verdict("PDF/A", "not checked", text))
    return found


def _file(folder: Path, name: str) -> Path:
    """A file in a folder, or in one of its folders; of several versions the newest."""
    found = [folder / name] if (folder / name).is_file() else sorted(folder.glob(f"*/{name}"))
    if not found:
        raise UsageError(f"has no {name}", where=folder, do="download the schema from https://www.ptb.de/dcc")
    return found[-1]


def _joined(check: str, reasons: Sequence[str], passed: str) -> Verdict:
    if not reasons:
        return Verdict(check, "passed", passed)
    more = len(reasons) - _SHOWN
    text = "; ".join(reasons[:_SHOWN]) + (f" (and {more} more)" if more > 0 else "")
    return Verdict(check, "failed", text, tuple(reasons))


def _schema(etree: Any, root: Any, xsd: Path) -> Verdict:
    try:
        schema = etree.XMLSchema(etree.parse(str(xsd), etree.XMLParser(no_network=True)))
    except (etree.XMLSchemaParseError, etree.XMLSyntaxError, OSError) as error:
        raise UsageError(f"cannot be used as a schema ({error})", where=xsd) from None
    schema.validate(root)
    reasons = [f"line {each.line}: {_short(each.message)}" for each in schema.error_log]
    return _joined("schema", reasons, f"valid against {xsd.name} of {xsd.parent.name}")


def _short(message: str) -> str:
    """A message of the schema without the namespaces that every name has."""
    return message.replace(f"{{{DCC}}}", "dcc:").replace(f"{{{SI}}}", "si:")


def _rules(xml: bytes, rules: Path) -> Verdict:
    fired = check_rules(xml, rules)
    warnings = sum(each.role == "warning" for each in fired)
    passed = f"no error by {rules.name}" + (f", {warnings} warnings" if warnings else "")
    return _joined("rules", [each.text for each in fired if each.role == "error"], passed)


def _signatures(xml: bytes, root: Any, trusted: Sequence[Path]) -> Verdict:
    if root.find(f".//{{{DS}}}Signature") is None:
        text = "not signed: changes cannot be found"
        return Verdict("signature", "failed" if trusted else "not checked", text)
    found = signatures(xml, trusted)
    failed = [text for state, text in found if state != "passed"]
    return _joined("signature", failed, "; ".join(text for _, text in found))


def _numbers(root: Any) -> Verdict:
    """Covariance matrices must be ones, and expanded uncertainties those that they give."""
    reasons, count = [], 0
    for vector in root.iter(f"{{{SI}}}realListXMLList"):
        matrix = vector.find(f".//{{{SI}}}covarianceMatrixXMLList")
        if matrix is None:
            continue
        count += 1
        where = f"covariance matrix {count}"
        try:
            columns = [
                [float(each.text) for each in column.iter(f"{{{SI}}}valueXMLList")] for column in matrix
            ]
            cov = np.array(columns, dtype=np.float64)
        except (TypeError, ValueError):
            reasons.append(f"{where} has no numbers")
            continue
        if cov.ndim != 2 or cov.shape[0] != cov.shape[1] or not np.isfinite(cov).all():
            reasons.append(f"{where} is not square")
            continue
        size = np.sqrt(np.maximum(np.diag(cov), 0.0))
        scaled = cov / np.outer(np.where(size > 0, size, 1.0), np.where(size > 0, size, 1.0))
        if np.abs(scaled - scaled.T).max() > 1e-9:
            reasons.append(f"{where} is not symmetric")
        elif (np.diag(cov) < 0).any() or np.linalg.eigvalsh(scaled)[0] < -1e-8 * len(cov):
            reasons.append(f"{where} has negative eigenvalues")
        expanded, factor = (
            vector.findtext(f".//{{{SI}}}expandedMUXMLList/{{{SI}}}{name}")
            for name in ("valueExpandedMUXMLList", "coverageFactorXMLList")
        )
        if expanded and factor:
            u, k = (np.array(text.split(), dtype=np.float64) for text in (expanded, factor))
            if len(u) != len(cov) or len(k) not in (1, len(u)):
                reasons.append(f"{where} has {len(cov)} rows, but {len(u)} uncertainties")
            elif (np.abs(u - k * size) > 1e-5 * k * size).any():
                reasons.append(f"{where} contradicts the expanded uncertainties")
    return _joined("numbers", reasons, f"{count} covariance matrices are consistent")


def _words(root: Any) -> Verdict:
    known = vocabulary()["refTypes"]
    used = {word for each in root.iter() for word in (each.get("refType") or "").split()}
    own = sorted(word for word in used if word.startswith(f"{NAMESPACE}_"))
    reasons = [f"{word!r} is not in our vocabulary" for word in own if word not in known]
    return _joined("vocabulary", reasons, f"{len(own)} of our reference types, all declared")


def _pages(root: Any, pdf: bytes, path: Path) -> Verdict:
    path_ = f".//{{{DCC}}}statement[@refType='{NAMESPACE}_pages']/{{{DCC}}}reference"
    stated = root.findtext(path_)
    if stated is None:
        return Verdict(
            "pages", "not checked", "the embedded certificate does not state the digest of its pages"
        )
    if not re.fullmatch(r"[0-9a-f]{64}", stated) or pages_digest(pdf, path) != stated:
        return Verdict("pages", "failed", "the pages are not those that the embedded certificate states")
    return Verdict("pages", "passed", "the pages are those that the embedded certificate states")


_SCH = "{http://purl.oclc.org/dsdl/schematron}"
_XSL = "{http://www.w3.org/1999/XSL/Transform}"


@dataclass(frozen=True)
class Fired:
    """An assertion that does not hold, or a report that does.

    Parameters
    ----------
    role : str
        error, warning or information.
    text : str
        What it says.

    Examples
    --------
    >>> Fired("error", "a method is missing").role
    'error'
    """

    role: str
    text: str


def check_rules(xml: bytes, rules: Path) -> list[Fired]:
    """Apply rules to a document.

    Parameters
    ----------
    xml : bytes
        The document, well-formed.
    rules : Path
        Schematron.

    Raises
    ------
    FormatError
        If the rules are none.
    """
    with optional():
        from lxml import etree
        from saxonche import PySaxonApiError, PySaxonProcessor

    stylesheet = etree.tostring(_stylesheet(etree, rules), encoding="unicode")
    with PySaxonProcessor(license=False) as processor:
        try:
            compiled = processor.new_xslt30_processor().compile_stylesheet(stylesheet_text=stylesheet)
            # Parsed by lxml before, so that neither parser resolves anything outside the document.
            plain = etree.tostring(
                etree.fromstring(xml, etree.XMLParser(resolve_entities=False)), encoding="unicode"
            )
            found = compiled.transform_to_string(xdm_node=processor.parse_xml(xml_text=plain))
        except PySaxonApiError as error:
            raise FormatError(f"cannot be applied ({error})", where=rules) from None
    root = etree.fromstring(found.encode("utf-8"))
    return [Fired(each.get("role"), " ".join("".join(each.itertext()).split())) for each in root]


def _stylesheet(etree: Any, rules: Path) -> Any:
    try:
        schema = etree.parse(str(rules), etree.XMLParser(no_network=True)).getroot()
    except (OSError, etree.XMLSyntaxError) as error:
        raise FormatError(f"cannot be read ({error})", where=rules) from None
    if schema.tag != f"{_SCH}schema":
        raise FormatError("is not Schematron", where=rules)
    spaces = {each.get("prefix"): each.get("uri") for each in schema.iter(f"{_SCH}ns")}
    spaces |= {"xsl": _XSL[1:-1], "xs": "http://www.w3.org/2001/XMLSchema"}
    sheet = etree.Element(f"{_XSL}stylesheet", nsmap=spaces, version="3.0")
    start = etree.SubElement(sheet, f"{_XSL}template", match="/")
    result = etree.SubElement(start, "fired")
    for k, pattern in enumerate(schema.iter(f"{_SCH}pattern")):
        mode = f"pattern{k}"
        etree.SubElement(result, f"{_XSL}apply-templates", select=".", mode=mode)
        # Nodes without a rule are passed through, their attributes included.
        etree.SubElement(sheet, f"{_XSL}mode", {"name": mode, "on-no-match": "shallow-skip"})
        found = pattern.findall(f"{_SCH}rule")
        for place, rule in enumerate(found):
            attributes = {"match": rule.get("context"), "mode": mode, "priority": str(len(found) - place)}
            template = etree.SubElement(sheet, f"{_XSL}template", attributes)
            for let in (*pattern.findall(f"{_SCH}let"), *rule.findall(f"{_SCH}let")):
                etree.SubElement(template, f"{_XSL}variable", name=let.get("name"), select=let.get("value"))
            for check in rule:
                if check.tag in (f"{_SCH}assert", f"{_SCH}report"):
                    _check(etree, template, check)
            etree.SubElement(template, f"{_XSL}apply-templates", select="@*|node()", mode=mode)
    return sheet


def _check(etree: Any, template: Any, check: Any) -> None:
    test = check.get("test")
    wanted = f"not({test})" if check.tag == f"{_SCH}assert" else test
    said = etree.SubElement(etree.SubElement(template, f"{_XSL}if", test=wanted), "said")
    said.set("role", check.get("role", "error"))
    for text, child in ((check.text, None), *((each.tail, each) for each in check)):
        if child is not None and child.tag == f"{_SCH}value-of":
            etree.SubElement(said, f"{_XSL}value-of", select=child.get("select"))
        if text:
            etree.SubElement(said, f"{_XSL}text").text = text
