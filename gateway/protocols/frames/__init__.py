"""Devices without a protocol: scales, barcode readers, inverters, VB-1COM style frames.

Vigor VB/VH manual B-3-9 and B-4, Liyan EX485LNK manual (user control mode), LS MASTER-K120S
manual 8.4.
"""

from gateway.protocols.frames.codec import FrameCodec, FrameReader
from gateway.protocols.frames.device import Frames
from gateway.protocols.frames.driver import FrameDriver
from gateway.protocols.frames.fields import Field
from gateway.protocols.frames.framing import Framing
from gateway.protocols.frames.listener import Listener
from gateway.protocols.frames.messages import Ask, Listen, Write
