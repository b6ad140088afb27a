"""A simulated Modbus slave, RTU, ASCII or TCP: plain, Vigor, LS K120S, or as the EX485LNK reads."""

from gateway.stations.modbus.station import ModbusStation, modbus_station
