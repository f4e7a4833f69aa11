"""Settings of a CANopen node, read and written over the bus that an adapter has open, by the library `canopen`."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoError

from softloop.devices.protocols.canopen_output import (
    NMT_ID,
    NMT_PRE_OPERATIONAL_COMMAND,
    STORE,
    STORE_SIGNATURE,
    Setting,
    writing_order,
)
from softloop.wire.can_frame import FLAG_ERROR
from softloop.wire.can_port import CanPort
from softloop.wire.clock import Clock
from softloop.wire.errors import Lost, Unavailable

_POLL_S = 0.01
_ANSWER_S, _ATTEMPTS = 0.5, 4
_STORE_ANSWER_S = 5.0  # a node that writes its memory answers when it has
_NO_ANSWER = "does not answer; are node_id and bit rate the node's, and is it powered?"


class _PortNetwork(canopen.Network):
    """The library's network on a CanPort, whose frames a thread takes while the conversation lasts."""

    def __init__(self, port: CanPort, clock: Clock) -> None:
        super().__init__()
        self._port, self._clock = port, clock
        self.lost: Lost | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="canopen", daemon=True)
        self._thread.start()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        if self.lost is not None:
            raise self.lost
        if not self._port.send(can_id, bytes(data), self._clock.now_ns()):
            raise Lost(f"CAN bus '{self._port.name}' takes no frames: is it up, and does anybody else speak on it?")

    def _listen(self) -> None:
        try:
            while not self._ending.is_set():
                frame = self._port.recv(_POLL_S)
                if frame is not None and not frame.flags & FLAG_ERROR:
                    self.notify(frame.arbitration_id, bytearray(frame.data[: frame.dlc]), frame.stamp_ns * 1e-9)
        except Lost as error:
            self.lost = error

    def end(self) -> None:
        self._ending.set()
        self._thread.join()


class NodeTalk:
    """A conversation with one node."""

    def __init__(self, network: _PortNetwork, node_id: int, where: str) -> None:
        self._network, self._node_id, self.where = network, node_id, where
        self._node = network.add_node(node_id, canopen.ObjectDictionary())
        self._node.sdo.RESPONSE_TIMEOUT, self._node.sdo.MAX_RETRIES = _ANSWER_S, _ATTEMPTS

    def read(self, setting: Setting) -> int | None:
        """What the node holds, of the sign of the setting's value; None when it has no such object. Raises Unavailable, Lost."""
        try:
            data = self._node.sdo.upload(setting.index, setting.sub)
        except SdoAbortedError:
            return None
        except SdoError:
            raise Unavailable(f"{self.where} {_NO_ANSWER}") from None
        return int.from_bytes(data, "little", signed=setting.value < 0)

    def wrong(self, settings: Sequence[Setting]) -> list[str]:
        """What the node holds otherwise than it must, a line for each. Raises as `read`."""
        found = []
        for setting in settings:
            held = self.read(setting)
            if held is None:
                found.append(f"{setting.name}: the node does not have it; it must hold {setting.value}")
            elif held != setting.value:
                found.append(f"{setting.name}: holds {held}, must hold {setting.value}")
        return found

    def write(self, settings: Sequence[Setting]) -> None:
        """Write settings, the node pre-operational meanwhile. Raises Unavailable where it refuses one, and as `read`."""
        self._network.send_message(NMT_ID, bytes((NMT_PRE_OPERATIONAL_COMMAND, self._node_id)))
        for setting in writing_order(settings):
            self._download(setting.index, setting.sub, setting.data, setting.name)

    def store(self) -> None:
        """Let the node keep its settings over a loss of power. Raises as `write`."""
        self._node.sdo.RESPONSE_TIMEOUT = _STORE_ANSWER_S
        self._download(*STORE, STORE_SIGNATURE.to_bytes(4, "little"), "1010h:01 (store)")
        self._node.sdo.RESPONSE_TIMEOUT = _ANSWER_S

    def _download(self, index: int, sub: int, data: bytes, name: str) -> None:
        try:
            self._node.sdo.download(index, sub, data)
        except SdoAbortedError as error:
            reason = SdoAbortedError.CODES.get(error.code, f"code 0x{error.code:08X}")
            raise Unavailable(f"{self.where}: refuses {name}: {reason}; it cannot vent by itself as it must") from None
        except SdoError:
            raise Unavailable(f"{self.where} {_NO_ANSWER}") from None


@contextmanager
def talking(port: CanPort, node_id: int, clock: Clock) -> Iterator[NodeTalk]:
    """A conversation with a node, on a port that receives the node's SDO answers and that nobody else reads meanwhile."""
    network = _PortNetwork(port, clock)
    try:
        yield NodeTalk(network, node_id, f"CANopen node {node_id} on CAN bus '{port.name}'")
    finally:
        network.end()
