"""The flashing of the ATmega32U4: the image's format and checks, and the bootloader's protocol. No IO."""
