"""Every protocol the gateway speaks: a driver's fields are its settings in the file."""

from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor

# One union of drivers is the whole registry; `protocol` tells them apart.
PlcDriver = Vigor | ComputerLink | ModbusRtu | ModbusAscii | ModbusTcp

__all__ = ["ComputerLink", "ModbusAscii", "ModbusRtu", "ModbusTcp", "PlcDriver", "Vigor"]
