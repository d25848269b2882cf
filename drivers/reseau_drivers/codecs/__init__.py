"""Protocols without sockets: bytes in, values out, and back.

A driver and its simulator share them. Decoders of streams take bytes as they come, in pieces of any size, and
yield messages, and :class:`~reseau_drivers.codecs.stream.Damaged` for what is none; they never keep more than
their limit, whatever length the wire announces, and find their way back after garbage. Functions that decode
one message raise :class:`~reseau.core.errors.ProtocolError`; those that encode raise
:class:`~reseau.core.errors.SettingError` for what cannot be sent.
"""
