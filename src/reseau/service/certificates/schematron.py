"""Schematron with queries of XSLT 2 (ISO/IEC 19757-3), translated to XSLT 3.

Each pattern is a mode, and each of its rules a template; within a pattern the first rule that matches a node
applies, and no other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...core.errors import FormatError
from ...core.optional import optional

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
