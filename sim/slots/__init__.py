"""A Bluetooth radio that spends its time in slots: piconets, polls, bridges between them, pages.

`parameters` says how such a radio is, and where each number comes from; `devices` has what a device and a link hold;
`radio` moves frames over links that are there; `calls` makes links; `connections` makes pairs of ends of them, for
virtual runs (`sim.virtual.radio.slot_air`) and for the process that is the radio of real ones (`sim.processes.radio`).
The core is pure: it runs on any clock that calls back, and its seed decides all that is random.
What is not in it: credits of L2CAP and RFCOMM, Wi-Fi in the same chip, fading, and any controller's firmware.
"""
