"""Requests to a program in place of a person."""

import pytest

from reseau.capture import RemoteOperator
from reseau.core.errors import ConnectionLost, DeadlineError, RefusedError, UsageError
from reseau_sims.serving import Fault, FaultScript, FaultyConnection, TcpServer
from reseau_sims.serving.person import SimulatedOperator


def test_requests_are_carried_out_or_refused_with_the_reason() -> None:
    done: list[str] = []
    person = SimulatedOperator({"cover": lambda: done.append("dark"), "light": lambda: done.append("lit")})
    with TcpServer(lambda: FaultyConnection(person)) as server:
        ask = RemoteOperator(server.address, 10.0)
        ask("cover the lens")
        ask("provide even light")
        with pytest.raises(RefusedError, match="the simulated operator cannot: make tea"):
            ask("make tea")
    assert done == ["dark", "lit"]


def test_a_program_that_is_not_there_or_does_not_answer_is_reported() -> None:
    with pytest.raises(UsageError, match="write tcp://host:port"):
        RemoteOperator("laboratory")
    silent = FaultyConnection(SimulatedOperator({}), FaultScript({0: Fault("dropped")}))
    with TcpServer(lambda: silent) as server:
        address = server.address
        with pytest.raises(DeadlineError, match="did not answer within 0"):
            RemoteOperator(address, 0.3)("cover the lens")
    with pytest.raises(ConnectionLost, match="start the program that `operator` names"):
        RemoteOperator(address, 5.0)("cover the lens")
