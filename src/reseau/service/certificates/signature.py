"""Signatures of certificates after XML-Signature, with keys of the user (xmlsec).

A signature covers the whole document (reference "", enveloped). A document in which it covers less, or that
has transforms that could hide a part, is refused. The certificate in a signature says who claims to have
signed; that it is genuine is known only where it is one of those that the user trusts. Its dates are not
checked.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...core.errors import FormatError, UsageError
from ...core.files import readable
from ...core.optional import optional

DS = "http://www.w3.org/2000/09/xmldsig#"
_CANONICAL = {
    "http://www.w3.org/TR/2001/REC-xml-c14n-20010315",
    "http://www.w3.org/2006/12/xml-c14n11",
    "http://www.w3.org/2001/10/xml-exc-c14n#",
}
_ENVELOPED = f"{DS}enveloped-signature"
_MORE = "http://www.w3.org/2001/04/xmldsig-more#"
_METHODS = {f"{_MORE}{kind}-sha{bits}" for kind in ("rsa", "ecdsa") for bits in (256, 384, 512)}
_DIGESTS = {
    "http://www.w3.org/2001/04/xmlenc#sha256",
    f"{_MORE}sha384",
    "http://www.w3.org/2001/04/xmlenc#sha512",
}


def sign(xml: bytes, key: Path, certificate: Path, password: str | None = None) -> bytes:
    """Sign a certificate.

    Parameters
    ----------
    xml : bytes
        The document.
    key, certificate : Path
        Private key (RSA or EC) and certificate of the signer, PEM.
    password : str, optional
        Password of the key.

    Raises
    ------
    InputError
        If key or certificate cannot be read.
    UsageError
        If they do not belong together, or packages are missing.

    Examples
    --------
    >>> signed = sign(xml, Path("key.pem"), Path("certificate.pem"))  # doctest: +SKIP
    """
    xmlsec, etree = _modules()
    private = _private(key, password)
    public = read_pem(certificate)
    root = etree.fromstring(xml, etree.XMLParser(resolve_entities=False, no_network=True))
    for method in (xmlsec.constants.TransformRsaSha256, xmlsec.constants.TransformEcdsaSha256):
        node = xmlsec.template.create(root, xmlsec.constants.TransformExclC14N, method, ns="ds")
        root.append(node)
        reference = xmlsec.template.add_reference(node, xmlsec.constants.TransformSha256, uri="")
        xmlsec.template.add_transform(reference, xmlsec.constants.TransformEnveloped)
        xmlsec.template.add_transform(reference, xmlsec.constants.TransformExclC14N)
        context = xmlsec.SignatureContext()
        context.key = private
        try:
            context.sign(node)
        except xmlsec.Error:
            root.remove(node)
            continue
        info = etree.SubElement(etree.SubElement(node, f"{{{DS}}}KeyInfo"), f"{{{DS}}}X509Data")
        etree.SubElement(info, f"{{{DS}}}X509Certificate").text = base64.encodebytes(public).decode("ascii")
        found: bytes = etree.tostring(root, xml_declaration=True, encoding="UTF-8")
        if signatures(found)[-1][0] != "passed":
            raise UsageError("does not belong to the key", where=certificate)
        return found
    raise UsageError("is not a key of RSA or EC", where=key)


def signatures(xml: bytes, trusted: Sequence[Path] = ()) -> list[tuple[str, str]]:
    """Verify all signatures of a document.

    Parameters
    ----------
    xml : bytes
        The document, well-formed.
    trusted : sequence of Path
        Certificates (PEM) of signers that are trusted; each signature must then be by one of them.

    Returns
    -------
    list of (str, str)
        State ("passed" or "failed") and text for each signature.

    Raises
    ------
    InputError
        If a certificate cannot be read.
    """
    xmlsec, etree = _modules()
    known = {hashlib.sha256(read_pem(path)).hexdigest(): path for path in trusted}
    root = etree.fromstring(xml, etree.XMLParser(resolve_entities=False, no_network=True))
    found = []
    for node in root.iter(f"{{{DS}}}Signature"):
        why = _structure(node, root)
        der = b"" if why else _embedded(node)
        if not why and not der:
            why = "has no certificate of its signer"
        if why:
            found.append(("failed", f"the signature {why}"))
            continue
        digest = hashlib.sha256(der).hexdigest()
        try:
            context = xmlsec.SignatureContext()
            context.key = xmlsec.Key.from_memory(_pem(der), xmlsec.constants.KeyDataFormatCertPem)
            context.verify(node)
        except xmlsec.Error:
            found.append(("failed", "the document was changed after it was signed"))
            continue
        who = f"certificate SHA-256 {digest}"
        if known and digest not in known:
            found.append(("failed", f"signed with {who}, which is not trusted"))
        else:
            by = f"by {known[digest]}" if digest in known else "whose owner is not known; use --trust"
            found.append(("passed", f"unchanged since it was signed, {by} ({who})"))
    return found


def _structure(node: Any, root: Any) -> str:
    """Why a signature does not cover the whole document, or is weak; empty where it is as it should be."""
    if node.getparent() is not root:
        return "is not at the end of the document"
    info = node.find(f"{{{DS}}}SignedInfo")
    references = [] if info is None else info.findall(f"{{{DS}}}Reference")
    if info is None or len(references) != 1 or references[0].get("URI") != "":
        return "does not cover the whole document"
    transforms = [each.get("Algorithm") for each in references[0].iter(f"{{{DS}}}Transform")]
    if transforms.count(_ENVELOPED) != 1 or not set(transforms) <= {_ENVELOPED, *_CANONICAL}:
        return "has transforms that can hide parts of the document"
    if any(len(each) for each in references[0].iter(f"{{{DS}}}Transform")):
        return "has transforms that can hide parts of the document"
    used = {
        f"{{{DS}}}SignatureMethod": _METHODS,
        f"{{{DS}}}CanonicalizationMethod": _CANONICAL,
        f"{{{DS}}}Reference/{{{DS}}}DigestMethod": _DIGESTS,
    }
    for path, allowed in used.items():
        each = info.find(path)
        if each is None or each.get("Algorithm") not in allowed:
            named = "none" if each is None else each.get("Algorithm")
            return f"uses a method that is not accepted: {named}"
    return ""


def _embedded(node: Any) -> bytes:
    """The first certificate of a signature, DER."""
    found = node.find(f".//{{{DS}}}X509Certificate")
    try:
        return b"" if found is None else base64.b64decode("".join((found.text or "").split()), validate=True)
    except ValueError:
        return b""


def _pem(der: bytes) -> bytes:
    text = base64.encodebytes(der)
    return b"-----BEGIN CERTIFICATE-----\n" + text + b"-----END CERTIFICATE-----\n"


def read_pem(path: Path) -> bytes:
    """Return the first certificate of a PEM file, DER.

    Raises
    ------
    InputError
        If the file cannot be read, or has none.
    """
    with readable(path):
        text = path.read_bytes().decode("ascii", "replace")
    _, begin, rest = text.partition("-----BEGIN CERTIFICATE-----")
    body, end, _ = rest.partition("-----END CERTIFICATE-----")
    try:
        if begin and end:
            return base64.b64decode("".join(body.split()), validate=True)
    except ValueError:
        pass
    raise FormatError("has no certificate (PEM)", where=path)


def _private(path: Path, password: str | None) -> Any:
    xmlsec, _ = _modules()
    with readable(path):
        content = path.read_bytes()
    if b"ENCRYPTED" in content and password is None:
        raise UsageError("has a password", where=path, do="set RESEAU_KEY_PASSWORD")
    try:
        return xmlsec.Key.from_memory(content, xmlsec.constants.KeyDataFormatPem, password)
    except (xmlsec.Error, ValueError):
        raise FormatError("is not a private key (PEM), or its password is wrong", where=path) from None


def _modules() -> tuple[Any, Any]:
    with optional():
        from lxml import etree
    try:
        with optional():
            import xmlsec
    except ImportError:
        raise
    except Exception as error:  # xmlsec.Error, as for another version of libxml2 than that of lxml
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"cannot be used: {error}", where="xmlsec") from None
    return xmlsec, etree
