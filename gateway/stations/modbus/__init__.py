"""A simulated Modbus slave, RTU, ASCII or TCP: plain, Vigor, LS K120S, or one EX485LNK calls."""

from gateway.stations.modbus.station import ModbusStation

__all__ = ["ModbusStation"]
