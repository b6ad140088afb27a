"""One process of a gateway runs on a machine."""

import os
import sys

import pytest

from gateway.errors import GatewayError
from gateway.northbound.session.one_process import only_process

OWN = f"plant/@gateway/demo{os.getpid()}"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has names without files")
def test_a_second_process_of_a_gateway_is_refused_until_the_first_has_ended() -> None:
    second = pytest.raises(GatewayError, match="runs already on this machine")
    with only_process(OWN, "[]", "[]"):
        with second, only_process(OWN, "[]", "[]"):
            pass
        with only_process(OWN, "[]", '["tcp/10.0.0.1:7447"]'), only_process(f"{OWN}-2", "[]", "[]"):
            pass
    with only_process(OWN, "[]", "[]"):
        pass
