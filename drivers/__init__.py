"""Device drivers, from wires to records: ``transports`` move bytes and know no protocol, protocol files know no I/O.

A new device is one file in ``gnss``, ``imu`` or ``scanner`` that declares ``DRIVERS``, and one folder in fixtures/.
"""
