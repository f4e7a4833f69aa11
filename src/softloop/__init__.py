"""softloop: hardware-in-the-loop control of pneumatic soft bending actuators over Zenoh and CAN."""

__version__ = "0.1.0"
