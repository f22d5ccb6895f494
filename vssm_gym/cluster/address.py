"""Check the address of a Ray cluster before Ray tries it, which it does for two minutes where nothing answers."""

import re
import socket

from vssm_gym.errors import InputError

AUTO = "auto"  # the cluster that runs on this machine
ANSWER_SECONDS = 5.0  # s within which the head answers
LAST_PORT = 65535  # of TCP
_HOST_PORT = re.compile(r"(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>\d{1,5})")


def check_address(address: str) -> None:
    """Raise :class:`InputError` unless ``address`` is ``auto``, or the ``HOST:PORT`` of a head that answers."""
    if address == AUTO:
        return
    if address.startswith("ray://"):
        expected = "auto or HOST:PORT: Ray's client mode (ray://) is not supported; start the command on a node"
        raise InputError("--ray", "address", expected)
    found = _HOST_PORT.fullmatch(address)
    if found is None or not 0 < int(found["port"]) <= LAST_PORT:
        raise InputError("--ray", "address", f"auto or HOST:PORT, as `ray start --head` prints it; found {address!r}")
    try:
        socket.create_connection((found["host"].strip("[]"), int(found["port"])), ANSWER_SECONDS).close()
    except OSError as error:
        expected = f"the head of a running cluster; {address} does not answer ({error.strerror or error})"
        raise InputError("--ray", "address", expected) from None
