"""A simulated swarm in processes: started, watched, restarted as systemd would, ended with nothing left behind."""
