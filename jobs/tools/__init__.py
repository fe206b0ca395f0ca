"""Jobs for recordings, cameras, policies and machines: calibrate, search, publish, replay, fingerprint."""
