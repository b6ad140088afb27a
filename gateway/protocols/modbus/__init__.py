"""Modbus RTU, ASCII and TCP, with the addresses of Vigor, LS K120S and EX485LNK."""

from gateway.protocols.modbus.ascii import AsciiCodec
from gateway.protocols.modbus.drivers import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.modbus.frame import Frame
from gateway.protocols.modbus.mbap import MbapCodec
from gateway.protocols.modbus.rtu import RtuCodec, RtuSlaveCodec
