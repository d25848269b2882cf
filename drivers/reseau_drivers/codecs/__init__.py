"""Protocols without input or output: bytes to values and back.

Drivers and simulators share these codecs. Stream decoders take bytes in pieces of any size and return
messages, and :class:`~reseau_drivers.codecs.stream.Damaged` for invalid data. They never store more than
their limit, whatever length the peer announces, and recover after invalid data. Functions that decode one
message raise :class:`~reseau.core.errors.ProtocolError`; functions that encode raise
:class:`~reseau.core.errors.SettingError` for values that cannot be sent.
"""
