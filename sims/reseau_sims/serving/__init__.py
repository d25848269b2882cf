"""Simulators behind the protocols of the real instruments: pseudo-terminals, TCP, UDP, SCPI, VXI-11, HiSLIP.

An instrument is a :class:`~reseau_sims.serving.machine.Machine`: bytes in, answers out, a list of what its
client did wrong. A :class:`~reseau_sims.serving.machine.Wire` spoils answers by a script; a server, or a link
within the process, carries it to a client. All of them listen on the loopback interface alone.
"""

from .bench import SimulatedBench
from .bk import BkScanner
from .compactpulser import CompactPulser
from .datagrams import UdpServer
from .gige import GigeCamera, aravis_is_installed
from .imaging import CameraBody, InLaboratory, Lamp, Pattern, Sight, Still, View
from .machine import Machine, Session, Wire
from .motion import Motor
from .oscilloscope import FAMILIES, Family, Oscilloscope
from .ping360 import Ping360
from .scpi import HislipInstrument, PortmapperSession, Vxi11Session
from .script import DEVICE_KINDS, KINDS, LINE_KINDS, Fault, Kind, Script
from .servers import InProcess, PtyServer, Server, TcpServer
from .smc100 import Smc100Line
from .usbtmc import UsbInstrument, plugged_in
from .v4l2 import VideoCamera
from .zaber import ZaberChain

__all__ = [
    "DEVICE_KINDS",
    "FAMILIES",
    "KINDS",
    "LINE_KINDS",
    "BkScanner",
    "CameraBody",
    "CompactPulser",
    "Family",
    "Fault",
    "GigeCamera",
    "HislipInstrument",
    "InLaboratory",
    "InProcess",
    "Kind",
    "Lamp",
    "Machine",
    "Motor",
    "Oscilloscope",
    "Pattern",
    "Ping360",
    "PortmapperSession",
    "PtyServer",
    "Script",
    "Server",
    "Session",
    "Sight",
    "SimulatedBench",
    "Smc100Line",
    "Still",
    "TcpServer",
    "UdpServer",
    "UsbInstrument",
    "VideoCamera",
    "View",
    "Vxi11Session",
    "Wire",
    "ZaberChain",
    "aravis_is_installed",
    "plugged_in",
]
