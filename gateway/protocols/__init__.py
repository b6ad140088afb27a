"""Every protocol the gateway speaks: a driver's fields are its settings in the file."""

from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.frames import Frames
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor

# One union is the whole registry; `protocol` tells its members apart. All are drivers but
# `Frames`, whose settings `FrameDriver` makes one of.
PlcDriver = Vigor | ComputerLink | ModbusRtu | ModbusAscii | ModbusTcp | Frames

__all__ = ["ComputerLink", "Frames", "ModbusAscii", "ModbusRtu", "ModbusTcp", "PlcDriver", "Vigor"]
