"""What `swarm measure` is made of: `senders` send, `figures` counts, `show` prints and draws; `rssi` asks the Bluetooth
adapter by `hci`."""
