"""The lab's virtual machines: how they are built, and how tests boot and command them."""
