"""How the ATmega32U4 gets its firmware: the image's format and checks, and the bootloader's protocol. No IO."""
