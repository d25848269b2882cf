"""The names of options that several commands, functions or files have: one name, one meaning.

`RowJitterPx` is the type of every field and parameter ``row_jitter_px``, in commands ``--row-jitter-px``. A
name carries its unit; lengths without one are in millimetres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from .options import Declared, Group, Option, declaration, words


def _position(text: str) -> dict[str, float]:
    """The position that a text such as ``tilt=0,roll=0`` writes."""
    pairs = [part.split("=") for part in words([text])]
    return {axis.strip(): float(value) for axis, value in pairs}


# What is read.
Design = Annotated[Path, Option("Design of the target.", Group.BASIC, "-d")]
TestObject = Annotated[Path, Option("Design of the test object: its rods.")]
Reseau = Annotated[Path, Option("Design of the reseau.", letter="-r")]
Network = Annotated[Path, Option("Network of images, reseau-network/1.", letter="-n")]
Targets = Annotated[
    Path, Option("Targets in space, reseau-targets/1: shape, size and direction.", letter="-t")
]
Lens = Annotated[Path, Option("Lens: lens/1 (TOML), Zemax .zmx or CODE V .seq.", letter="-l")]
Corners = Annotated[Path, Option("Calibrated corners of the frame, frame-corners/1.", letter="-c")]
Control = Annotated[Path, Option("Control points, CSV id,x,y,z[,sx,sy,sz].", Group.TARGET)]
Sensor = Annotated[Path, Option("Calibration of the sensor; correct images with it before measuring.")]
Poses = Annotated[Path, Option("CSV of poses, one column for each axis.")]
Rules = Annotated[Path, Option("Rules of acceptance, reseau-acceptance/1.")]
Data = Annotated[Path, Option("Data of the certificate, reseau-certificate-data/1.")]
Covariates = Annotated[Path, Option("Table with the columns calibration and, for example, temperature [°C].")]

# What is written.
Out = Annotated[Path, Option("File or folder to write.", Group.BASIC, "-o")]
Report = Annotated[Path, Option("Report to write, HTML.")]
Figure = Annotated[Path, Option("Figure to write.")]
Overlay = Annotated[Path, Option("Overlay to write, PNG: what was measured, what was declined, and why.")]
Svg = Annotated[Path, Option("SVG drawing to write.")]
Pdf = Annotated[Path, Option("PDF drawing to write.")]
Anyway = Annotated[bool, Option("Go on with a calibration that is usable for nothing.", Group.FILES)]
AsJson = Annotated[bool, Option("Write JSON to standard output.", Group.FILES, called="json")]

# Images and marks.
Channel = Annotated[
    Literal["luma", "red", "green", "blue", "interpolated"],
    Option("Channel of colour images; `luma` of raw files: all pixels, behind their filters."),
]
Mirrored = Annotated[
    bool,
    Option("The image shows the target from behind, or in a mirror.", Group.TARGET, off="--not-mirrored"),
]
Negative = Annotated[
    bool,
    Option("The scan shows bright marks dark, and dark ones bright.", Group.TARGET, off="--positive"),
]
MaxRotationDeg = Annotated[
    float,
    Option("Largest rotation of the target in the image (degrees).", Group.TARGET, least=0, most=180),
]
RowJitterPx = Annotated[
    float, Option("Standard deviation of the shift of single rows of the sensor (px).", Group.CAMERA, least=0)
]
Fill = Annotated[
    float,
    Option(
        "Light-sensitive share of the pitch of a pixel, along either axis.", Group.CAMERA, least=0, most=1
    ),
]
PsfPx = Annotated[
    float, Option("Width of the point-spread function (px, one sigma).", Group.CAMERA, least=0.1)
]
MarkPx = Annotated[float, Option("Size of a mark (px).")]
SearchPx = Annotated[float, Option("Largest distance from the predicted position (px).", least=1)]
Region = Annotated[
    tuple[int, int, int, int],
    Option("Region of a slanted edge (px).", value="LEFT,TOP,WIDTH,HEIGHT"),
]
Dpi = Annotated[
    float,
    Option(
        "Resolution of the scan (dots per inch), if that in the file is missing or wrong.",
        Group.CAMERA,
        least=10,
        most=100_000,
    ),
]
FormatMm = Annotated[
    tuple[float, float],
    Option(
        "Width and height of a frame of film (mm). By default the usual formats are tried.",
        Group.CAMERA,
        value="WIDTHxHEIGHT",
    ),
]
ImageSize = Annotated[
    tuple[int, int], Option("Width and height of images (px).", Group.CAMERA, value="WIDTHxHEIGHT")
]
Transform = Annotated[
    Literal["similarity", "affine", "projective", "bilinear"],
    Option("Transformation to the calibrated coordinates.", Group.ADJUSTMENT),
]
Dictionary = Annotated[str, Option("Markers, as OpenCV's DICT_5X5_100.", Group.TARGET)]
BorderBits = Annotated[int, Option("Width of the border of a marker (bits).", Group.TARGET, least=1, most=4)]

# Designs.
Columns = Annotated[int, Option("Number of columns: marks, squares, circles or tags in a row.", least=1)]
Rows = Annotated[int, Option("Number of rows.", least=1)]
Pitch = Annotated[float, Option("Distance between neighbouring marks of a design (mm).")]
Size = Annotated[float, Option("Size of a mark (mm).")]
LineWidth = Annotated[float, Option("Width of lines (mm).")]
Number = Annotated[int, Option("Number of marks.", least=1)]
Shape = Annotated[Literal["line-grid", "cross", "disk", "square"], Option("Shape of a mark.")]
Polarity = Annotated[Literal["dark", "bright"], Option("Dark or bright marks.")]
Paper = Annotated[
    Literal["A4", "A3", "Letter", "Tabloid", "own"],
    Option(
        "Paper of the PDF. Larger targets are divided over several sheets, with marks to join them; own is a "
        "page as large as the target needs.",
        Group.FILES,
    ),
]

# Cameras and lenses.
Model = Annotated[str, Option("Camera model.", Group.CAMERA, value="NAME")]
PitchMm = Annotated[float, Option("Size of a pixel (mm).", Group.CAMERA, least=1e-6, most=1)]
Free = Annotated[
    tuple[str, ...],
    Option("Parameters to estimate.", Group.CAMERA, value="c,x0,y0,K1"),
]
Focus = Annotated[
    float,
    Option(
        "Distance from the front of the lens at which objects in air are sharp (mm). Default: the image "
        "plane of the lens file.",
        Group.CAMERA,
        least=1e-3,
    ),
]
FNumber = Annotated[
    float, Option("F-number, if the stop is not as wide as in the lens file.", Group.CAMERA, least=0.3)
]

# Adjustment.
SigmaPx = Annotated[
    float, Option("Standard deviation of all image coordinates (px).", Group.ADJUSTMENT, least=1e-6)
]
ControlSigma = Annotated[
    float,
    Option(
        "Standard deviation of control points, in the unit of the network; of MicMac's the factor on them.",
        Group.ADJUSTMENT,
        least=1e-9,
    ),
]
SensorWidth = Annotated[
    float,
    Option(
        "Width of the sensor (mm) of cameras of other programs whose lengths are in pixels.",
        Group.CAMERA,
        least=1e-3,
    ),
]
Alpha = Annotated[float, Option("Significance level of a single test.", Group.ADJUSTMENT)]
Reject = Annotated[bool, Option("Reject gross errors by data snooping.", Group.ADJUSTMENT)]
Components = Annotated[
    Literal["axes", "images", "cameras"],
    Option("Estimate variance components of x and y, of each image, or of each camera.", Group.ADJUSTMENT),
]
Eliminate = Annotated[
    float,
    Option(
        "Drop distortion parameters that are not significant at this level, e.g. 0.05; cross-validate.",
        Group.ADJUSTMENT,
    ),
]
Distance = Annotated[
    list[float],
    Option("Distance at which to map the uncertainty of the projection; repeatable.", Group.ADJUSTMENT),
]
Initial = Annotated[
    Literal["given", "centroid", "edge"],
    Option(
        "Ordinary coordinates: given (those of the network), centroid, or edge (ellipses), measured near the "
        "given ones.",
        Group.ADJUSTMENT,
    ),
]
Rounds = Annotated[int, Option("Largest number of rounds.", Group.ADJUSTMENT, least=1)]
Probability = Annotated[float, Option("Coverage probability.")]

# Execution.
MemoryGb = Annotated[
    float,
    Option(
        "Memory that the normal equations may take (GB), by default half of what is available. Larger "
        "networks are solved by conjugate gradients, without some of their statistics.",
        Group.EXECUTION,
        least=0,
    ),
]
Jobs = Annotated[
    int, Option("Number of processes; by default the number of cores.", Group.EXECUTION, least=1)
]
Cluster = Annotated[
    str,
    Option(
        "Scheduler of a Dask cluster that does the work, in place of processes; requires --store.",
        Group.EXECUTION,
        value="tcp://HOST:PORT",
        environment="RESEAU_CLUSTER",
    ),
]
Store = Annotated[
    str,
    Option(
        "Folder or URL that keeps what is computed: a repeated command continues where it ended. Workers of "
        "a cluster share it.",
        Group.EXECUTION,
        environment="RESEAU_STORE",
    ),
]
Seed = Annotated[int, Option("Seed of the random numbers.", Group.EXECUTION, least=0)]
Seconds = Annotated[float, Option("End after this time (s); 0: no limit.", Group.EXECUTION, least=0)]
Limit = Annotated[int, Option("Largest number of entries to print; 0: no limit.", least=0)]

# Archive and bench.
Archive = Annotated[
    str,
    Option(
        "Archive: a folder, or the URL of a database.",
        Group.FILES,
        "-a",
        environment="RESEAU_ARCHIVE",
    ),
]
Objects = Annotated[str, Option("Folder or URL of the files, if the archive is a database.", Group.FILES)]
Name = Annotated[str, Option("Name of the session, design or calibration.", letter="-n")]
At = Annotated[str, Option("Time in question, such as 2026-03-29T08:00Z. Default: now.", value="TIME")]
Since = Annotated[
    str, Option("From when on it applies, such as 2026-03-29T08:00Z. Default: now.", value="TIME")
]
By = Annotated[str, Option("By whom. Default: the user.")]
Comment = Annotated[str, Option("The reason.", letter="-m")]
Decision = Annotated[str, Option("Decision, by the start of its key.")]
Recorded = Annotated[
    list[str], Option("Covariate that a sensor measured with the frames: temperature; repeatable.")
]
Bench = Annotated[Path, Option("Bench file.", Group.BASIC, "-b")]
Camera = Annotated[str, Option("Camera of the bench. Default: the only one.", Group.EXECUTION)]
Table = Annotated[str, Option("Turntable of the bench. Default: the only one.", Group.EXECUTION)]
Scanner = Annotated[str, Option("Ultrasonic scanner of the bench. Default: the only one.", Group.EXECUTION)]
Oscilloscope = Annotated[str, Option("Oscilloscope of the bench. Default: the only one.", Group.EXECUTION)]
Park = Annotated[
    dict[str, float],
    Option(
        "Final position of the table. Default: the last pose.", Group.EXECUTION, value="tilt=0,roll=0",
        parse=_position,
    ),
]  # fmt: skip
Retreat = Annotated[
    dict[str, float],
    Option(
        "Position after an abort or an error. Default: no movement.", Group.EXECUTION, value="tilt=0,roll=0",
        parse=_position,
    ),
]  # fmt: skip
Until = Annotated[str, Option("Choose poses until a goal is reached, as 'sigma_c < 0.5 um'.", value="GOAL")]
First = Annotated[int, Option("With a goal: number of poses before the first chosen one.", least=4)]
Body = Annotated[bool, Option("Take PHOTO III.")]
Levels = Annotated[int, Option("Number of exposure times in light.", least=5)]
Frames = Annotated[int, Option("Number of frames for each exposure time.", least=2)]
Count = Annotated[int, Option("Number of frames or sections to take.", least=1)]
Check = Annotated[
    tuple[str, ...],
    Option("Marks used as check points only.", Group.ADJUSTMENT, value="A1,B2"),
]
Average = Annotated[int, Option("Number of exposures averaged to one frame.", Group.EXECUTION, least=1)]
Checks = Annotated[
    int,
    Option("Number of frames for the checks before the acquisition; 0: no checks.", Group.EXECUTION, least=0),
]
Retakes = Annotated[int, Option("Number of additional attempts after a bad frame.", Group.EXECUTION, least=0)]
Home = Annotated[bool, Option("First home axes without a reference. The axes move.", Group.EXECUTION)]
Resume = Annotated[bool, Option("Continue what is not complete.", Group.EXECUTION)]
Auto = Annotated[bool, Option("First set exposure and gain by the brightness of the image.")]
LongestMs = Annotated[float, Option("Longest exposure time (ms).", least=0.001)]
Set = Annotated[list[str], Option("Value to set; repeatable.", value="NAME=VALUE", called="set")]

# Service.
State = Annotated[
    Path,
    Option(
        "Folder of accounts and keys. Default: beside the archive.",
        environment="RESEAU_STATE",
    ),
]
Accounts = Annotated[
    str, Option("URL of the database of accounts. Default: a file in the state folder.", Group.FILES)
]
Server = Annotated[
    str,
    Option("Address of the service.", Group.EXECUTION, "-s", environment="RESEAU_SERVER"),
]
Authority = Annotated[
    Path, Option("Certificate by which that of the service is checked (PEM).", Group.EXECUTION)
]
Subject = Annotated[
    Literal["camera", "oscilloscope", "film"],
    Option("What is calibrated: a camera, an oscilloscope by PHOTO I, II and III, or a roll of film."),
]
Port = Annotated[int, Option("Port; 0: a free one.", least=0, most=65535)]
Scope = Annotated[Literal["read", "operate", "administer"], Option("What it may do.")]
SigningKey = Annotated[
    Path,
    Option("Private key that signs certificates of calibrations (PEM); its password: RESEAU_KEY_PASSWORD."),
]
SigningCertificate = Annotated[Path, Option("Certificate of the signing key (PEM).")]
Notify = Annotated[list[str], Option("Where to send alarms: a URL of apprise; repeatable.", value="URL")]
Inside = Annotated[
    list[str],
    Option("Network inside to which alarms may be sent, as 192.168.1.0/24; repeatable.", value="NETWORK"),
]
Repeat = Annotated[float, Option("Repeat alarms after this time (h).", least=0.01)]
Every = Annotated[float, Option("Time between two repetitions (s).", Group.EXECUTION, least=0.01)]


def names() -> dict[str, Declared]:
    """Return the vocabulary: meanings by the names of fields and parameters.

    Examples
    --------
    >>> names()["pitch_mm"].help
    'Size of a pixel (mm).'
    """
    found = {}
    for key, hint in globals().items():
        declared = declaration(hint)
        if declared is not None:
            snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in key).lstrip("_")
            found[snake] = declared
    return found
