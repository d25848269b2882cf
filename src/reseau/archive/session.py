"""A session of an archive: frames, verdicts, results and events, each stored before the next action."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Engine

from ..core.data import Frame
from ..core.errors import ArchiveError, InputError
from ..core.provenance import sha256_of
from ..core.version import __version__
from ..io import write_whole
from ..io.scans import Scan
from . import schema
from .objects import Objects
from .picture import frame_of, scan_in, tiff_of
from .records import ArchivedFrame, ArchivedResult, Verdict, utc, utc_now

INPUT = "input"
"""Kind of the input files of a session."""
_GIVEN = schema.verdicts.alias()
_GOOD_STEPS = sa.func.count(sa.distinct(sa.case((schema.verdicts.c.ok, schema.frames.c.step))))
"""Parts of queries; made for each query they would be garbage that only a search for cycles finds."""


class _Stored(NamedTuple):
    """A file in the store, with what its entry in the index says."""

    sha256: str
    suffix: str
    size: int
    key: Mapping[str, Any]
    facts: dict[str, Any]
    clock: dict[str, Any]


class Session:
    """A session of an archive; see :meth:`Archive.begin` and :meth:`Archive.session`.

    Parameters
    ----------
    engine : Engine
        Database engine of the index.
    objects : Objects
        Store of the files.
    row : mapping
        Row of the session in the index.
    clock : callable
        Returns the present time, UTC.

    Examples
    --------
    >>> import numpy as np, tempfile
    >>> from reseau.archive import Archive
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     session = archive.begin("monday", "frames", {"count": 1})
    ...     frame = session.store("00000", Frame(np.zeros((2, 3), np.uint8), 255.0))
    ...     session.judge(frame, Verdict(True))
    ...     session.end("done")
    ...     [(each.name, each.verdict.ok) for each in session.frames()], session.status
    ([('00000/frame', True)], 'done')
    """

    def __init__(
        self,
        engine: Engine,
        objects: Objects,
        row: Mapping[str, Any],
        clock: Callable[[], datetime] = utc_now,
    ) -> None:
        self._engine, self.objects, self._clock = engine, objects, clock
        self._id: int = row["id"]
        self.name: str = row["name"]
        self.plan: str = row["plan"]
        self.parameters: dict[str, Any] = row["parameters"]
        self.bench: str = row["bench"]
        self.software: str = row["software"]
        self.begun = utc(row["begun"])

    def store(
        self,
        step: str,
        picture: Frame | Scan | bytes,
        *,
        kind: str = "frame",
        take: int = 0,
        suffix: str = ".tif",
        facts: Mapping[str, Any] | None = None,
        clock: Mapping[str, Any] | None = None,
    ) -> ArchivedFrame:
        """Store a picture durably, first the file, then the index entry.

        Parameters
        ----------
        step : str
            Pose or photograph it belongs to.
        picture : Frame, Scan or bytes
            A frame, a scan with its colours, or a file as sent by an instrument.
        kind : str
            Kind of picture.
        take : int
            Attempt number, from 0.
        suffix : str
            Suffix of the file, for bytes.
        facts, clock : mapping, optional
            Metadata; and, separately, times and counters.

        Returns
        -------
        ArchivedFrame
            The stored picture; the existing one if there is one of this step, kind and take.

        Raises
        ------
        ArchiveError
            If it cannot be stored.
        """
        there = self.find(step, kind, take)
        if there is not None:
            return there
        known = dict(facts or {})
        key = {"session": self.name, "step": step, "kind": kind, "take": take}
        data = picture if isinstance(picture, bytes) else tiff_of(picture, known | key)
        suffix = suffix if isinstance(picture, bytes) else ".tif"
        stored = _Stored(self.objects.put(data, suffix), suffix, len(data), key, known, dict(clock or {}))
        return self._enter([stored])[0]

    def store_set(
        self,
        step: str,
        frames: Mapping[str, Frame],
        *,
        kind: str = "frame",
        take: int = 0,
        facts: Mapping[str, Mapping[str, Any]] | None = None,
        clock: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> list[ArchivedFrame]:
        """Store frames that several cameras exposed at once: all of them, or none.

        Parameters
        ----------
        step : str
            Pose or photograph they belong to; each is stored under ``camera/step``.
        frames : mapping of str to Frame
            Frame of each camera.
        kind, take
            As for :meth:`store`.
        facts, clock : mapping of str to mapping, optional
            Metadata, and times and counters, by camera.

        Returns
        -------
        list of ArchivedFrame
            The stored pictures; the existing ones if there are pictures of this step, kind and take.

        Raises
        ------
        ArchiveError
            If they cannot be stored.

        Notes
        -----
        They are entered into the index in one transaction. Each file names the others of its exposure by a
        hash of all pixels, so that a set of which only some files were written is not taken for one.
        """
        there = [self.find(f"{camera}/{step}", kind, take) for camera in frames]
        if all(there):
            return [each for each in there if each is not None]
        pixels = "".join(
            f"{camera} {sha256_of(frame.pixels.tobytes())}\n" for camera, frame in frames.items()
        )
        of_set = {"exposure": step, "cameras": list(frames), "set": sha256_of(pixels.encode())}
        stored = []
        for camera, frame in frames.items():
            known = dict((facts or {}).get(camera, {})) | of_set | {"camera": camera}
            key = {"session": self.name, "step": f"{camera}/{step}", "kind": kind, "take": take}
            data = tiff_of(frame, known | key)
            times = dict((clock or {}).get(camera, {}))
            stored.append(_Stored(self.objects.put(data, ".tif"), ".tif", len(data), key, known, times))
        return self._enter(stored)

    def _enter(self, stored: Sequence[_Stored]) -> list[ArchivedFrame]:
        """Enter stored files into the index, all at once."""
        entered = []
        with schema.connected(self._engine) as connection:
            for each in stored:
                step, kind, take = (each.key[name] for name in ("step", "kind", "take"))
                values = {
                    "session_id": self._id, "step": step, "kind": kind, "take": take, "sha256": each.sha256,
                    "suffix": each.suffix, "size": each.size, "facts": each.facts, "clock": each.clock,
                    "stored": self._clock(),
                }  # fmt: skip
                made = connection.execute(schema.frames.insert().values(values)).inserted_primary_key
                assert made is not None
                file = each.sha256, each.suffix, each.size, each.facts, each.clock
                entered.append(ArchivedFrame(made[0], step, kind, take, *file))
        return entered

    def recover(self) -> list[ArchivedFrame]:
        """Enter frames into the index whose process was killed after writing the file.

        Of frames that were exposed at once all must be there, or none is entered.
        """
        with schema.connected(self._engine, reading=True) as connection:
            known = set(connection.scalars(sa.select(schema.frames.c.sha256)))
        found: list[ArchivedFrame] = []
        sets: dict[tuple[Any, ...], dict[str, _Stored]] = {}
        for sha256, suffix in self.objects.names():
            if suffix != ".tif" or sha256 in known:
                continue
            data = self.objects.get(sha256, suffix)
            try:
                _, facts = frame_of(data, sha256)
            except ArchiveError:
                continue
            key = {name: facts.pop(name, None) for name in ("session", "step", "kind", "take")}
            if key["session"] == self.name and self.find(key["step"], key["kind"], key["take"]) is None:
                stored = _Stored(sha256, suffix, len(data), key, facts, {"recovered": True})
                if "set" not in facts:
                    found += self._enter([stored])
                    continue
                exposure = facts["exposure"], key["kind"], key["take"], facts["set"]
                sets.setdefault(exposure, {})[facts["camera"]] = stored
        for members in sets.values():
            cameras = next(iter(members.values())).facts["cameras"]
            complete = [members[camera] for camera in cameras if camera in members]
            first = complete[0].key
            # Another set of this exposure may have been entered just before.
            if len(complete) == len(cameras) and not self.find(first["step"], first["kind"], first["take"]):
                found += self._enter(complete)
        return found

    def _frames(
        self, *where: sa.ColumnElement[bool], first: int | None = None, last: int | None = None
    ) -> list[ArchivedFrame]:
        f, v = schema.frames.c, schema.verdicts.c
        columns = (f.id, f.step, f.kind, f.take, f.sha256, f.suffix, f.size, f.facts, f.clock)
        query = self._judged(sa.select(*columns, v.ok, v.why, v.facts), *where)
        query = query.order_by(f.id).limit(first) if last is None else query.order_by(f.id.desc()).limit(last)
        with schema.connected(self._engine, reading=True) as connection:
            rows: list[Any] = list(connection.execute(query).all())
        if last is not None:
            rows.reverse()
        made: Any = ArchivedFrame
        return [made(*row[:9], None if row[9] is None else Verdict(*row[9:])) for row in rows]

    def _judged(self, query: Any, *where: sa.ColumnElement[bool]) -> Any:
        """Make a query one of pictures of this session, each with its last verdict."""
        f, v, given = schema.frames.c, schema.verdicts.c, _GIVEN.c
        latest = sa.select(sa.func.max(given.id)).where(given.frame_id == f.id).scalar_subquery()
        joined: Any = query.select_from(schema.frames).outerjoin(schema.verdicts, v.id == latest)
        return joined.where(f.session_id == self._id, *where)

    def find(self, step: str, kind: str = "frame", take: int = 0) -> ArchivedFrame | None:
        """Return the picture of a step, kind and take, or None."""
        f = schema.frames.c
        found = self._frames(f.step == step, f.kind == kind, f.take == take)
        return found[0] if found else None

    def frame(self, number: int) -> ArchivedFrame | None:
        """Return the picture with a number, or None."""
        found = self._frames(schema.frames.c.id == number)
        return found[0] if found else None

    def frames(
        self,
        step: str | None = None,
        kind: str | None = None,
        *,
        ok: bool | None = None,
        inputs: bool = True,
        after: int = 0,
        first: int | None = None,
        last: int | None = None,
    ) -> list[ArchivedFrame]:
        """Return pictures in the order in which they were stored, with their last verdicts.

        Parameters
        ----------
        step, kind : str, optional
            Only those of a step, or of a kind.
        ok : bool, optional
            Only those with this verdict.
        inputs : bool
            Whether input files are among them.
        after : int
            Only those with larger numbers.
        first, last : int, optional
            Only so many, from the beginning or from the end.
        """
        f = schema.frames.c
        where = [f.id > after] if after else []
        where += [] if step is None else [f.step == step]
        where += [] if kind is None else [f.kind == kind]
        where += [] if inputs else [f.kind != INPUT]
        where += [] if ok is None else [schema.verdicts.c.ok == ok]
        return self._frames(*where, first=first, last=last)

    def counts(self) -> tuple[int, int]:
        """Return the number of frames, and that of steps with a good one."""
        query = self._judged(sa.select(sa.func.count(), _GOOD_STEPS), schema.frames.c.kind == "frame")
        with schema.connected(self._engine, reading=True) as connection:
            taken, steps = connection.execute(query).one()
        return taken, steps

    def picture(self, archived: ArchivedFrame) -> Frame:
        """Read a frame, checked against its SHA-256.

        Raises
        ------
        ArchiveError
            If it is lost, damaged, or not a frame.
        """
        return frame_of(self.objects.get(archived.sha256, archived.suffix), archived.name)[0]

    def scan(self, archived: ArchivedFrame) -> Scan:
        """Read a frame with its colours, checked against its SHA-256.

        Raises
        ------
        ArchiveError
            If it is lost, damaged, or not a frame.
        """
        return scan_in(self.objects.get(archived.sha256, archived.suffix), archived.name)

    def inputs(self) -> dict[str, ArchivedFrame]:
        """Return the input files of the session, by name."""
        return {each.step: each for each in self.frames(kind=INPUT)}

    def input(self, name: str) -> str:
        """Read an input file.

        Raises
        ------
        ArchiveError
            If no input has this name, or it is lost or damaged.
        """
        found = self.find(name, INPUT)
        if found is None:
            raise ArchiveError(f"has no input {name}", where=self.name)
        return self.objects.get(found.sha256, found.suffix).decode("utf-8")

    def judge(self, archived: ArchivedFrame, verdict: Verdict) -> None:
        """Store a verdict on a frame. The last one counts; all are stored."""
        row = {"frame_id": archived.id, "ok": verdict.ok, "why": verdict.why, "facts": verdict.facts}
        with schema.connected(self._engine) as connection:
            connection.execute(schema.verdicts.insert().values(row))

    def keep(
        self,
        name: str,
        content: str | bytes,
        parameters: Mapping[str, Any] | None = None,
        inputs: Mapping[str, str] | None = None,
    ) -> ArchivedResult:
        """Store a result with its provenance.

        Parameters
        ----------
        name : str
            Name of the file, with suffix.
        content : str or bytes
            Content of the file.
        parameters : mapping, optional
            Parameters of the computation.
        inputs : mapping, optional
            SHA-256 of its inputs, by role.

        Raises
        ------
        ArchiveError
            If it cannot be stored.
        """
        data = content.encode("utf-8") if isinstance(content, str) else content
        suffix, software, known = Path(name).suffix, f"reseau {__version__}", dict(parameters or {})
        sha256 = self.objects.put(data, suffix)
        row = {
            "session_id": self._id,
            "name": name,
            "sha256": sha256,
            "suffix": suffix,
            "size": len(data),
            "parameters": known,
            "software": software,
            "stored": self._clock(),
        }
        made_of = dict(inputs or {})
        with schema.connected(self._engine) as connection:
            made = connection.execute(schema.results.insert().values(row)).inserted_primary_key
            assert made is not None
            roles = [{"result_id": made[0], "role": k, "sha256": v} for k, v in made_of.items()]
            if roles:
                connection.execute(schema.inputs.insert(), roles)
        return ArchivedResult(made[0], name, sha256, suffix, len(data), known, made_of, software)

    def results(self) -> list[ArchivedResult]:
        """Return the results in the order in which they were stored."""
        r, i = schema.results.c, schema.inputs.c
        columns = (r.id, r.name, r.sha256, r.suffix, r.size, r.parameters, r.software)
        with schema.connected(self._engine, reading=True) as connection:
            query = sa.select(*columns).where(r.session_id == self._id).order_by(r.id)
            rows = connection.execute(query).all()
            roles = connection.execute(
                sa.select(i.result_id, i.role, i.sha256)
                .join(schema.results)
                .where(r.session_id == self._id)
                .order_by(i.id)
            ).all()
        return [
            ArchivedResult(*row[:6], inputs={k: v for n, k, v in roles if n == row[0]}, software=row[6])
            for row in rows
        ]

    def content(self, result: ArchivedResult) -> bytes:
        """Read the file of a result, checked against its SHA-256."""
        return self.objects.get(result.sha256, result.suffix)

    def write_results(self, folder: Path) -> None:
        """Write the latest result of each name to a folder, created if it does not exist.

        Raises
        ------
        InputError
            If the folder cannot be created or written.
        """
        contents = {result.name: self.content(result) for result in self.results()}
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(
                f"cannot be created ({error.strerror})", where=folder, do="name a folder"
            ) from None
        for name, content in contents.items():
            write_whole(folder / name, content)

    def note(self, key: str, kind: str, document: Mapping[str, Any]) -> None:
        """Store an event; do nothing if there is one with this key."""
        e = schema.events
        with schema.connected(self._engine) as connection:
            there = sa.select(e.c.id).where(e.c.session_id == self._id, e.c.key == key)
            if connection.scalar(there) is None:
                row = {"session_id": self._id, "key": key, "kind": kind, "document": dict(document)}
                connection.execute(e.insert().values(row))

    def notes(self, kind: str | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield kind and document of the events, in order."""
        e = schema.events.c
        query = sa.select(e.kind, e.document).where(e.session_id == self._id).order_by(e.id)
        with schema.connected(self._engine, reading=True) as connection:
            rows = connection.execute(query if kind is None else query.where(e.kind == kind)).all()
        yield from ((row[0], row[1]) for row in rows)

    def end(self, status: str, why: str = "") -> None:
        """Store the status at the end; a session that is resumed ends again."""
        row = {"session_id": self._id, "status": status, "why": why, "at": self._clock()}
        with schema.connected(self._engine) as connection:
            connection.execute(schema.ends.insert().values(row))

    @property
    def status(self) -> str:
        """Last status: done, stopped or failed; or `not ended`."""
        return self.last_end[0]

    @property
    def last_end(self) -> tuple[str, str]:
        """Last status, and why."""
        e = schema.ends.c
        query = sa.select(e.status, e.why).where(e.session_id == self._id).order_by(e.id.desc()).limit(1)
        with schema.connected(self._engine, reading=True) as connection:
            row = connection.execute(query).one_or_none()
        return ("not ended", "") if row is None else (row[0], row[1])
