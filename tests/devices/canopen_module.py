"""A CANopen output module in memory: `canopen`'s local node, and what such a module does by itself when nobody is heard.

The library answers SDO, NMT and heartbeat. What it leaves to the application is here: set points from the receive PDO as
mapped, its deadline, the consumer of the gate's heartbeat, and error values.
"""

import struct
import threading
import time

import can
import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable
from canopen.objectdictionary import datatypes as dt

OPERATIONAL, PRE_OPERATIONAL, STOPPED = "OPERATIONAL", "PRE-OPERATIONAL", "STOPPED"
_STATES = {0: PRE_OPERATIONAL, 1: None, 2: STOPPED}
_FORMATS = {dt.UNSIGNED8: "<B", dt.UNSIGNED16: "<H", dt.UNSIGNED32: "<I", dt.INTEGER16: "<h", dt.INTEGER32: "<i"}
POLL_S = 0.001


def variable(name, index, sub, kind, default=0):
    made = ODVariable(name, index, sub)
    made.data_type, made.access_type, made.default = kind, "rw", default
    return made


def record(od, index, members, kind=ODRecord):
    made = kind(f"{index:x}", index)
    for sub, (data_type, default) in members.items():
        made.add_member(variable(f"{index:x}sub{sub}", index, sub, data_type, default))
    od.add_object(made)


def dictionary(outputs, rpdo, without=(), measured=0):
    """A module fresh from its box: nothing watches the host."""
    od = canopen.ObjectDictionary()
    od.add_object(variable("heartbeat", 0x1017, 0, dt.UNSIGNED16))
    objects = {
        0x1010: {1: (dt.UNSIGNED32, 1)},
        0x1016: {0: (dt.UNSIGNED8, 1), 1: (dt.UNSIGNED32, 0)},
        0x1029: {0: (dt.UNSIGNED8, 1), 1: (dt.UNSIGNED8, 0)},
        0x1400 + rpdo - 1: {1: (dt.UNSIGNED32, 0x80000000), 2: (dt.UNSIGNED8, 1), 5: (dt.UNSIGNED16, 0)},
        0x1600 + rpdo - 1: {0: (dt.UNSIGNED8, 0), 1: (dt.UNSIGNED32, 0), 2: (dt.UNSIGNED32, 0)},
        0x6411: dict.fromkeys(outputs, (dt.INTEGER16, 0)),
        0x6443: dict.fromkeys(outputs, (dt.UNSIGNED8, 0)),
        0x6444: dict.fromkeys(outputs, (dt.INTEGER32, 0)),
    }
    if measured:
        objects |= {
            0x1800: {1: (dt.UNSIGNED32, 0x80000000), 2: (dt.UNSIGNED8, 1), 5: (dt.UNSIGNED16, 0)},
            0x1A00: {0: (dt.UNSIGNED8, 0), 1: (dt.UNSIGNED32, 0), 2: (dt.UNSIGNED32, 0)},
            measured: dict.fromkeys(outputs, (dt.INTEGER16, 0)),
        }
    for index, members in objects.items():
        if index not in without:
            record(od, index, members, ODArray if 0 not in members and index < 0x6000 else ODRecord)
    return od


class Module:
    """Runs from its making to `close`. `counts` are what its outputs give now, by sub-index.

    Attributes:
        clock: gives the time that it goes by, s. `looks` counts how often it looked whether a deadline has passed.
    """

    def __init__(self, bus, node_id=1, outputs=(1, 2), rpdo=2, shift=16, without=(), measured=0):
        self.outputs, self.rpdo, self.shift, self.measured = outputs, rpdo, shift, measured
        self.without = without
        self.counts = dict.fromkeys(outputs, 0)
        self.clock, self.looks = time.monotonic, 0
        self.in_error, self.stored = False, 0
        self.vented_at = 0.0
        self.network = canopen.Network(bus)
        self.node = self.network.create_node(node_id, dictionary(outputs, rpdo, without, measured))
        self.node.add_write_callback(self.on_write)
        self.pdo_at = self.heartbeat_at = self.told_at = 0.0
        self.lock = threading.RLock()
        self.boot()
        self.network.notifier = can.Notifier(bus, [self.listen], 0.01)
        self.ending = False
        self.thread = threading.Thread(target=self.watch, daemon=True)
        self.thread.start()

    def boot(self):
        """As after power-on."""
        self.pdo_at = self.heartbeat_at = 0.0
        self.counts = dict.fromkeys(self.outputs, 0)
        self.node.nmt.send_command(0)
        self.node.nmt.send_command(129)
        self.node.nmt.state = PRE_OPERATIONAL

    def power_cycle(self):
        """It forgets what was not stored, and tells that it is back."""
        self.node.nmt.stop_heartbeat()
        self.node.data_store.clear()
        self.boot()

    def on_write(self, index, subindex, od, data):
        self.stored += index == 0x1010 and data == b"save"

    def held(self, index, sub):
        obj = self.node.object_dictionary[index]
        kind = (obj if isinstance(obj, ODVariable) else obj[sub]).data_type
        return struct.unpack(_FORMATS[kind], self.node.get_data(index, sub))[0]

    def listen(self, message):
        with self.lock:
            self.network.notify(message.arbitration_id, message.data, message.timestamp)
            consumer = 0 if 0x1016 in self.without else self.held(0x1016, 1)
            if message.arbitration_id == 0x700 + (consumer >> 16) and consumer & 0xFFFF:
                self.heartbeat_at = self.clock()
            identifier = self.held(0x1400 + self.rpdo - 1, 1)
            if message.arbitration_id == identifier and self.node.nmt.state == OPERATIONAL:
                self.take(bytes(message.data))

    def take(self, data):
        """A receive PDO, by its mapping."""
        mapping = 0x1600 + self.rpdo - 1
        for i in range(self.held(mapping, 0)):
            entry = self.held(mapping, i + 1)
            assert (entry >> 16, entry & 0xFF) == (0x6411, 16)
            self.counts[entry >> 8 & 0xFF] = struct.unpack_from("<h", data, 2 * i)[0]
        self.pdo_at, self.in_error = self.clock(), False

    def watch(self):
        while not self.ending:
            time.sleep(POLL_S)
            with self.lock:
                self.look(self.clock())
                self.looks += 1

    def look(self, now):
        deadline = 0 if 0x1400 + self.rpdo - 1 in self.without else self.held(0x1400 + self.rpdo - 1, 5)
        consumer = 0 if 0x1016 in self.without else self.held(0x1016, 1) & 0xFFFF
        if self.pdo_at and deadline and now - self.pdo_at > deadline * 1e-3:
            self.pdo_at = 0.0
            self.fail(0x8250)
        if self.heartbeat_at and consumer and now - self.heartbeat_at > consumer * 1e-3:
            self.heartbeat_at = 0.0
            self.fail(0x8130)
        if self.node.nmt.state == STOPPED and not self.in_error:
            self.error_values()
        self.tell(now)

    def fail(self, code):
        """A communication error: an emergency message, and the state of 1029h."""
        self.node.emcy.send(code, 0x10)
        state = _STATES[0 if 0x1029 in self.without else self.held(0x1029, 1)]
        if state is not None:
            self.node.nmt.state = state
        self.error_values()

    def error_values(self):
        self.in_error, self.vented_at = True, self.clock()
        for sub in self.outputs:
            if 0x6443 not in self.without and self.held(0x6443, sub) == 1:
                self.counts[sub] = self.held(0x6444, sub) >> self.shift

    def tell(self, now):
        """Measured currents, where it has any."""
        if not self.measured or self.node.nmt.state != OPERATIONAL:
            return
        identifier, period_ms = self.held(0x1800, 1), self.held(0x1800, 5)
        if not identifier & 0x80000000 and period_ms and now - self.told_at >= period_ms * 1e-3:
            self.told_at = now
            self.network.send_message(identifier, struct.pack("<hh", *(self.counts[sub] for sub in self.outputs)))

    def close(self):
        self.ending = True
        self.thread.join(5.0)
        self.network.check()  # what went wrong in its thread
        self.node.nmt.stop_heartbeat()
        self.network.disconnect()
