"""Handlers of serial port URLs, found by pyserial through `softloop.wire.serial_urls`."""
