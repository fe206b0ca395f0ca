"""Jobs on a recording, camera, policy or machine: calibrate, search, publish, replay, fingerprint."""
