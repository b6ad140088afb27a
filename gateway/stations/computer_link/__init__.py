"""A simulated Liyan EX or Mitsubishi FX PLC on the Computer Link."""

from gateway.stations.computer_link.station import ComputerLinkStation, computer_link_station

__all__ = ["ComputerLinkStation", "computer_link_station"]
