"""Mock hardware: devices that answer on loopback sockets as the real ones do, each in a process of its own."""
