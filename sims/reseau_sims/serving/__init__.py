"""Simulated instruments behind the protocols of the real ones.

Transports are pseudo-terminals, TCP, UDP, VXI-11, HiSLIP, USBTMC, Video4Linux and GigE Vision. An instrument
is a :class:`~reseau_sims.serving.machine.Machine`: bytes in, answers out, and a list of protocol violations
of its client. A :class:`~reseau_sims.serving.machine.FaultyConnection` injects faults into the answers; a
server, or a link within the process, connects it to a client. All servers listen on the loopback interface
only.
"""

from .bench import SimulatedBench
from .bk import BkScanner
from .compactpulser import CompactPulser
from .environment import Air, LineSensor, ModbusSensor, ScpiSensor
from .faults import DEVICE_KINDS, KINDS, LINE_KINDS, Fault, FaultScript, Kind
from .gige import GigeCamera, aravis_is_installed
from .gigevision import GigeVisionCamera, loopback_addresses
from .grbl import GrblController
from .imaging import LaboratoryScene, LampScene, Scene, SimulatedCamera, StillScene, StripeScene, View
from .kinesis import KinesisController
from .machine import FaultyConnection, Machine, Session
from .marlin import MarlinController
from .motion import Motor
from .oscilloscope import FAMILIES, Family, Oscilloscope
from .person import SimulatedHands, SimulatedOperator
from .ping360 import Ping360
from .scpi import HislipInstrument, PortmapperSession, Vxi11Session
from .servers import InProcess, PtyServer, Server, TcpServer, UdpServer
from .smc100 import Smc100Line
from .usbtmc import UsbInstrument, plugged_in
from .v4l2 import VideoCamera
from .zaber import ZaberChain

__all__ = [
    "DEVICE_KINDS",
    "FAMILIES",
    "KINDS",
    "LINE_KINDS",
    "Air",
    "BkScanner",
    "CompactPulser",
    "Family",
    "Fault",
    "FaultScript",
    "FaultyConnection",
    "GigeCamera",
    "GigeVisionCamera",
    "GrblController",
    "HislipInstrument",
    "InProcess",
    "Kind",
    "KinesisController",
    "LaboratoryScene",
    "LampScene",
    "LineSensor",
    "Machine",
    "MarlinController",
    "ModbusSensor",
    "Motor",
    "Oscilloscope",
    "Ping360",
    "PortmapperSession",
    "PtyServer",
    "Scene",
    "ScpiSensor",
    "Server",
    "Session",
    "SimulatedBench",
    "SimulatedCamera",
    "SimulatedHands",
    "SimulatedOperator",
    "Smc100Line",
    "StillScene",
    "StripeScene",
    "TcpServer",
    "UdpServer",
    "UsbInstrument",
    "VideoCamera",
    "View",
    "Vxi11Session",
    "ZaberChain",
    "aravis_is_installed",
    "loopback_addresses",
    "plugged_in",
]
