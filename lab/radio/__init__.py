"""Bluetooth Classic controllers and the air between them, for kernels that have none (hci_vhci)."""
