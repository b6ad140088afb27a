"""A simulated Liyan EX or Mitsubishi FX PLC on the Computer Link."""

from gateway.protocols.computer_link import ComputerLink
from gateway.stations.computer_link.station import ComputerLinkStation


def computer_link_station(driver: ComputerLink) -> ComputerLinkStation:
    """Returns the station that the driver can talk to."""
    return ComputerLinkStation(
        driver.station, driver.profile, driver.frame_format, driver.sum_check
    )
