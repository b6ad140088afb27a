"""Liyan EX and Mitsubishi FX: the Computer Link of the Liyan manual Lylink-edoc0307."""

from gateway.protocols.computer_link.codec import (
    Ack,
    Enquiry,
    Frame,
    LinkCodec,
    Nak,
    Text,
)
from gateway.protocols.computer_link.driver import ComputerLink
from gateway.protocols.computer_link.replies import NO_REPLY_CAUSES
