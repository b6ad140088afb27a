"""Vigor M, VB and VH: the computer link of "Communication Protocol of M, VB and VH Series", B-5."""

from gateway.protocols.vigor.codec import Frame, Reply, Request, VigorCodec
from gateway.protocols.vigor.driver import Vigor
