"""Wrong input and wrong use: one line that says what, where and what to do; exit status; nothing written."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from reseau.calibration import Calibration
from reseau.calibration.assessment import Assessment, Use
from reseau.calibration.document import Covariance, Quantity
from reseau.designs import coded_testfield
from reseau.io.images import write_image
from reseau_sims import FieldBench

from ..measure.photographs import UNEVEN
from ..measure.photographs import camera as aerial_camera
from ..measure.photographs import photograph as aerial_photograph
from .test_bundle import content

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(photo: Any, calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good and bad inputs of all kinds."""
    folder = tmp_path_factory.mktemp("inputs")

    def write(name: str, text: str | bytes) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())

    def document(name: str, value: dict[str, Any]) -> None:
        write(name, json.dumps(value))

    rng = np.random.default_rng(0)
    image, design = photo.image.read_bytes(), json.loads(photo.design.read_text())
    write("photo.png", image)
    write("truncated.png", image[:2000])
    write("empty.png", b"")
    write("text.png", "not an image")
    write("noise.png", b"")
    for name, grey in (("black.png", 0), ("white.png", 255), ("grey/a.png", 80), ("grey/b.png", 80)):
        (folder / name).parent.mkdir(exist_ok=True)
        write_image(folder / name, np.full((300, 360), grey, np.uint8))
    write_image(folder / "noise.png", rng.integers(90, 110, (300, 360)).astype(np.uint8))
    write_image(folder / "small.png", np.rint(photo.pixels).astype(np.uint8)[:40, :40].copy())
    write_image(folder / "ramp.png", np.tile(np.arange(200, dtype=np.uint8), (200, 1)))
    tifffile.imwrite(folder / "deep.tif", np.rint(photo.pixels * 100).astype(np.uint16))
    (folder / "none").mkdir()
    for name in "ab":
        write(f"text/{name}.png", "no image")
    write("design.json", photo.design.read_bytes())
    document("key.json", design | {"colour": "red"})
    document("twice.json", design | {"points": design["points"] + design["points"][:1]})
    far = [
        p | {"nominal_px": [3000.0 + 100 * i, 2000.0 + 100 * (i % 3)]} for i, p in enumerate(design["points"])
    ]
    document("far.json", design | {"points": far})
    write("brace.json", "{")
    FieldBench(seed=4).design.write(folder / "field.json")
    for name in "abc":
        seen = photo.view(photo.grid.xy) + rng.normal(size=(len(photo.grid.ids), 2))
        rows = "".join(f"{mark},{x},{y}\n" for mark, (x, y) in zip(photo.grid.ids, seen, strict=True))
        write(f"tables/{name}.csv", "id,x,y\n" + rows)
    write("few.csv", "id,x,y\n" + "".join(rows.splitlines(keepends=True)[:3]))
    write("p.csv", "id,x,y\na,20,30\n")
    for name, rows in CONTROL.items():
        write(f"control-{name}.csv", rows)
    for name, rows in ANGLES.items():
        write(f"angles-{name}.csv", rows)
    stored = json.loads(calibration.read_text())
    write("refined.json", calibration.read_bytes())
    document("model.json", stored | {"model": "brown"})
    document("terms.json", stored | {"model": stored["model"] | {"mapping": {}}})
    document("sigma0.json", {key: value for key, value in stored.items() if key != "sigma0"})
    for name, use in (("lens", Use.MEASUREMENT), ("poor", Use.NOTHING)):
        values = {"fx": 800.0, "fy": 800.0, "cx": 179.5, "cy": 149.5}
        Calibration(
            kind="camera", name="camera", sigma0=None, redundancy=0,
            model={"model": "opencv", "width": 360, "height": 300, "pitch_mm": [1.0, 1.0]},
            parameters={key: Quantity(value=value, sigma=0.1, unit="px") for key, value in values.items()},
            covariance=Covariance(names=(), matrix=()),
            assessment=Assessment(use=use, lines=(), centre_px=0.5, corners_px=4.0),
        ).write(folder / f"{name}.json")  # fmt: skip
    network = content()
    document("network.json", network)
    document("datum.json", {key: value for key, value in network.items() if key != "datum"})
    aerial_camera(UNEVEN).write(folder / "aerial.json")
    document("aerial-unit.json", json.loads((folder / "aerial.json").read_text()) | {"unit": "m"})
    write_image(folder / "scan.tif", aerial_photograph(UNEVEN)[0])
    coded_testfield().write(folder / "coded.json")
    write("bench.toml", 'schema = "reseau-bench/1"\nname = "empty"\n[instruments]\n')
    write("key.toml", "[")
    return folder


CONTROL = {
    "header": "id,x,y\na,1,2\n",
    "twice": "id,x,y,z\na,1,2,3\na,1,2,3\n",
    "fields": "id,x,y,z\na,1,2\n",
    "word": "id,x,y,z\na,1,two,3\n",
    "negative": "id,x,y,z,sx,sy,sz\na,1,2,3,0,-1,0\n",
    "unseen": "id,x,y,z\nnowhere,1,2,3\n",
    "empty": "id,x,y,z\n",
}
ANGLES = {
    "header": "image,angle\na,1\n",
    "other": "image,angle_deg\nother.png,1\n",
    "negative": "image,angle_deg,sigma_deg\na,1,-2\n",
    "missing": "image,angle_deg,sigma_deg\na,,1\n",
    "twice": "image,angle_deg\na,1\na,2\n",
    "word": "image,angle_deg\na,x\n",
}
WRONG = """
nonsense
    2 No such command 'nonsense'…
measure reseau
    2 Missing argument 'IMAGE'…
measure reseau photo.png
    2 Missing option '--design' / '-d'…
measure reseau photo.png -d design.json --out a.bmp
    2 a.bmp: has the suffix '.bmp'; use .json, .csv
measure reseau photo.png -d design.json --out no/a.json
    2 no/a.json: its folder does not exist; create the folder first
measure reseau text.png -d design.json --out o.json
    2 text.png: is not a PNG, JPEG, TIFF or BMP image
measure reseau truncated.png -d design.json --out o.json
    2 truncated.png: is a truncated image; copy or scan it again
measure reseau empty.png -d design.json --out o.json
    2 empty.png: is empty; copy or scan it again
measure reseau missing.png -d design.json --out o.json
    2 missing.png: cannot be read (No such file or directory)
measure reseau none -d design.json --out o.json
    2 none: cannot be read (Is a directory)
measure reseau black.png -d design.json --out o.json
    1 black.png: is all black; check exposure and shutter
measure reseau white.png -d design.json --out o.json
    1 white.png: is all saturated; check exposure and shutter
measure reseau noise.png -d design.json --out o.json
    1 noise.png: design 'disks' was not found in the frame of 360×300 px (0 of 63 marks agree with it)
measure reseau small.png -d design.json --out o.json
    1 small.png: design 'disks' was not found in the frame of 40×40 px (0 of 63 marks agree with it)
measure reseau photo.png -d far.json --out o.json
    1 photo.png: design 'disks' was not found in the frame of 360×300 px (0 of 63 marks agree with it)
measure reseau photo.png -d key.json --out o.json
    2 key.json: unknown key `colour`
measure reseau photo.png -d twice.json --out o.json
    2 twice.json: duplicate id 'A1' in `points`
measure reseau photo.png -d brace.json --out o.json
    2 brace.json: is not JSON (…
measure reseau photo.png -d refined.json --out o.json
    2 refined.json: has the schema 'reseau-calibration/1'; 'reseau-design/1' was expected
measure reseau photo.png -d missing.json --out o.json
    2 missing.json: cannot be read (No such file or directory)
measure reseau photo.png -d photo.png --out o.json
    2 photo.png: is not UTF-8 text; check the file name
measure reseau photo.png -d design.json --overlay photo.png
    2 photo.png: would replace the image; choose another name
measure reseau photo.png -d design.json --overlay o.jpg
    2 o.jpg: has the suffix '.jpg'; use .png
measure reseau photo.png -d design.json --overlay no/o.png
    2 no/o.png: its folder does not exist; create the folder first
measure board photo.png -d design.json
    2 design.json: has the schema 'reseau-design/1'; 'reseau-board/1' was expected
measure testfield ramp.png -d coded.json
    1 ramp.png: no spots form the lattice of a testfield
measure fiducials scan.tif -d aerial-unit.json
    2 aerial-unit.json: `unit`: Input should be 'mm'
measure fiducials noise.png -d aerial.json
    1 noise.png: the pattern of the 4 marks of 'test camera' is not in the image; check that it is a …
measure fiducials scan.tif -d wild-rc11
    2 fiducial marks: no camera has the name 'wild-rc11'; known are wild-rc8, wild-rc8-crosses, …
design reseau --columns many
    2 Invalid value for '--columns': Input should be…
design reseau --columns 1
    2 design reseau: cannot have 1 × 11 marks at 10.0 mm; at least two columns and rows are needed, …
design reseau --svg a.png
    2 a.png: has the suffix '.png'; use .svg
design reseau --pitch 0.2
    2 design reseau: marks of 0.3 mm do not fit a pitch of 0.2 mm
design testfield --pitch 90 --spread 30 --large 17,25,25,22 --out f.json
    2 design testfield: targets 30 mm apart do not fit squares of 90 mm
design fiducials --out f.json
    2 --out: needs the NAME of a camera; without --out all are listed
refine --photo-i photo.png --reseau design.json --alpha 2
    2 alpha: 2 is not between 0 and 1
refine --photo-i few.csv --reseau design.json --out K.json
    1 few.csv: 3 of 3 points are marks with coordinates in design 'disks'; four are needed at least
refine --photo-i noise.png --reseau design.json --out K.json
    1 noise.png: design 'disks' was not found in the frame of 360×300 px (0 of 63 marks agree with it)
refine --photo-i black.png --reseau design.json --out K.json
    1 black.png: is all black; check exposure and shutter
refine --photo-ii photo.png --reseau design.json
    2 refine: needs PHOTO I and its reseau, or a calibration
calibrate
    2 photographs: are missing; name IMAGES, or --rig for each camera
calibrate none
    2 none: has no photograph; put some in: .jpg, .png, .tif, .heic
calibrate missing
    2 missing: cannot be read (No such file or directory)
calibrate text -d field.json
    1 text: 0 images show the target, 3 are needed, 10 are good; a.png, b.png: is not a PNG, JPEG, …
calibrate grey -d field.json
    1 grey: 0 images show the target, 3 are needed, 10 are good; a.png, b.png: is all of one grey; …
calibrate tables/a.csv tables/b.csv -d design.json --image-size 360x300
    1 tables: 2 images (a.csv, b.csv) show the target, 3 are needed, 10 are good
calibrate tables -d design.json
    2 size of the images: is not known without a photograph; give width and height (image_size)
calibrate grey -d missing.json
    2 missing.json: cannot be read (No such file or directory)
calibrate grey -d field.json --out photo.png
    2 photo.png: has the suffix '.png'; use .json…
calibrate grey -d field.json --out no/folder
    2 no/folder: its folder does not exist; create the folder first
calibrate TABLES --pitch-mm 0.027 --free c,fx
    2 fx: is not one of c, x0, y0, K1, K2, K3, P1, P2, B1, B2
calibrate TABLES --model brwon
    2 camera model 'brwon': is unknown; use one of brown, brown_higher, opencv, opencv_full, fisheye, …
calibrate TABLES --side inner
    2 Invalid value for '--side': 'inner' is not one of 'image', 'object'…
calibrate TABLES --image-size large
    2 --image-size: cannot interpret 'large'; write WIDTHxHEIGHT
calibrate TABLES --distance -3
    2 --distance: -3 is not positive
calibrate TABLES --cluster tcp://127.0.0.1:9
    2 --cluster: requires a store that all workers share; add --store
calibrate TABLES --motion vx
    2 --motion: requires --rolling-shutter
calibrate TABLES --control control-header.csv
    2 control-header.csv: is not a table of control points; start with the header id,x,y,z[,sx,sy,sz]
calibrate TABLES --control control-twice.csv
    2 control-twice.csv, line 3: point a appears twice
calibrate TABLES --control control-fields.csv
    2 control-fields.csv, line 2: has 3 fields, not 4
calibrate TABLES --control control-word.csv
    2 control-word.csv, line 2: 'two' is not a number
calibrate TABLES --control control-negative.csv
    2 control-negative.csv: the sigma of point a is negative
calibrate TABLES --control control-unseen.csv
    2 control point nowhere: was measured in no image
calibrate TABLES --control control-empty.csv
    2 control-empty.csv: contains no points
calibrate TABLES --turntable angles-header.csv
    2 angles-header.csv: is not a table of angles; start with the header …
calibrate TABLES --turntable angles-other.csv
    2 turntable: has none of the photographs, but other.png; name them as a.csv
calibrate TABLES --turntable angles-negative.csv
    2 angles-negative.csv: the sigma of the angle of image 'a' is negative
calibrate TABLES --turntable angles-missing.csv
    2 angles-missing.csv: image 'a' has a sigma, but no angle of the turntable
calibrate TABLES --turntable angles-twice.csv
    2 angles-twice.csv: image 'a' has two angles of the turntable
calibrate TABLES --turntable angles-word.csv
    2 angles-word.csv, line 2: 'x' is not a number
calibrate --rig left -d design.json
    2 --rig: cannot interpret 'left'; write name=files, each name once
calibrate --rig left=tables -d design.json
    2 cameras of a rig: 1 is too few: at least two are required
calibrate --rig left=tables --rig left=grey -d design.json
    2 --rig: cannot interpret 'left=grey'; write name=files, each name once
calibrate --rig left=zzz* --rig right=tables -d design.json
    2 zzz*: matches no file
calibrate photo.png --rig left=tables --rig right=grey -d design.json
    2 photo.png: cannot be combined with --rig
bundle network.json --free K7
    2 K7: is no parameter of a camera; use one of c, x0, y0, K1, K2, K3, P1, P2, B1, B2
bundle network.json --free left:K1
    2 left: is not a camera of the network
bundle network.json --free K1 --fix K1
    2 parameter K1: is both free and fixed
bundle network.json --sigma-px 0
    2 Invalid value for '--sigma-px': Input should be…
bundle network.json --datum free --control control-twice.csv
    2 --datum free: cannot be combined with --control
bundle network.json --eliminate 1.5
    2 --eliminate: 1.5 is not between 0 and 1
bundle network.json --camera-calibration lens.json
    2 --camera-calibration: cannot interpret 'lens.json'; write ID=calibration.json, each ID once
bundle datum.json
    2 datum.json: missing key `datum`
bundle brace.json
    2 brace.json: is not JSON (…
apply missing.json photo.png
    2 missing.json: cannot be read (No such file or directory)
apply lens.json
    2 SOURCE: is missing; give an image, a folder, a video or points
apply lens.json small.png
    2 small.png: has 40×40 pixels, the calibrated images 360×300; use an image of that size, or …
apply lens.json photo.png --out photo.png
    2 photo.png: is an input of this command; choose another name for --out
apply lens.json photo.png --fov wide
    2 --fov: cannot interpret 'wide'; write keep, all or an angle in degrees
apply lens.json photo.png --scale 0
    2 --scale: 0 is not positive
apply lens.json photo.png --directions
    2 --directions: applies to points only
apply lens.json photo.png --object-coordinates
    2 --object-coordinates: needs a calibration of an oscilloscope, not of a camera
apply lens.json photo.png --exposure-ms 5
    2 --exposure-ms: needs a calibration of a sensor, not of a camera
apply lens.json --tables t.png
    2 t.png: has the suffix '.png'; use .npz, .yml or .xml (OpenCV), or .pgm (ffmpeg)
apply poor.json photo.png --out o.png
    2 calibration camera: is not usable: 0.5 px at the centre, 4 px in the corners; it is not applied; …
apply refined.json deep.tif --out o.jpg
    2 o.jpg: cannot hold grey values of type uint16; use .tif
apply model.json photo.png --out o.png
    2 model.json: `model`: is not the model of a calibration
apply terms.json photo.png --out o.png
    2 model of calibration disks photo: has a damaged or missing entry: model: missing key `terms`
apply sigma0.json photo.png --out o.png
    2 sigma0.json: missing key `sigma0`
export lens.json
    2 reseau export: nothing to write; give --to, --micmac or --metashape
export lens.json --to ros
    2 --to FORMAT and --out FILE: must be given together
export lens.json --to rso --out o.yaml
    2 rso: is not one of opencv, ros, kalibr, basalt, colmap, mrcal, metashape, photomodeler, dbat, micmac, …
export poor.json --to ros --out o.yaml
    2 calibration camera: is not usable: 0.5 px at the centre, 4 px in the corners; it is not …
export none --micmac m
    2 none: has no oriented scan; use `reseau orient --out`
export design.json --to ros --out o.yaml
    2 design.json: has the schema 'reseau-design/1'; 'reseau-calibration/1' was expected
compare lens.json photo.png
    2 photo.png: is not UTF-8 text; check the file name
compare lens.json refined.json
    2 calibration disks photo: is a calibration of an oscilloscope, not of a camera
uncertainty design.json
    2 design.json: has the schema 'reseau-design/1'; 'reseau-calibration/1' was expected
orient none
    2 none: has no photograph; put some in: .jpg, .png, .tif, .heic
orient photo.png --format-mm 36
    2 --format-mm: cannot interpret '36'; write WIDTHxHEIGHT
capture frames
    2 bench empty: has no camera; add one under [instruments] of its file
capture frames --bench missing.toml
    2 missing.toml: cannot be read (No such file or directory)
capture frames --bench key.toml
    2 key.toml: is not TOML (…
capture testfield
    2 --design: is missing; give the file
bench expose --out o.png
    2 bench empty: has no camera; add one under [instruments] of its file
demo --seed -1
    2 Invalid value for '--seed': Input should be…
schema reseau-net/1
    2 reseau schema: 'reseau-net/1' is not the name of a schema; run it without a name for all
"""
"""Commands, and what they answer: exit status and message, of which … is any rest."""

TABLES = "tables --design design.json --image-size 360x300 --out K.json"


def answers() -> list[Any]:
    lines = WRONG.strip().splitlines()
    return [
        pytest.param(asked.replace("TABLES", TABLES), *said.split(maxsplit=1), id=asked)
        for asked, said in zip(lines[::2], lines[1::2], strict=True)
    ]


@pytest.mark.parametrize(("command", "status", "message"), answers())
def test_wrong_input_is_one_line_and_writes_nothing(
    reseau: Run, folder: Path, monkeypatch: pytest.MonkeyPatch, command: str, status: str, message: str
) -> None:
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    code, out, err = reseau(*shlex.split(command))
    assert (code, out) == (int(status), "")
    assert err.count("\n") == 1
    assert re.fullmatch(re.escape(f"reseau: {message}").replace("…", ".*"), err[:-1])
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.slow
def test_the_program_itself_exits_without_a_traceback(photo: Any, tmp_path: Path) -> None:
    code = f"from reseau.cli import main; main(['measure', 'reseau', 'x.png', '-d', {str(photo.design)!r}])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "reseau: x.png: cannot be read (No such file or directory)\n"
