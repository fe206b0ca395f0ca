"""The world, its sensor and the Gymnasium environment made of them."""


def register() -> None:
    """Register `evade/Corridor-v0` with Gymnasium; calling it again changes nothing."""
    # Imported here because most users of the package need no environment.
    import gymnasium

    if "evade/Corridor-v0" not in gymnasium.registry:
        gymnasium.register(
            id="evade/Corridor-v0",
            entry_point="envs.corridor:CorridorEnv",
            vector_entry_point="envs.corridor:CorridorVectorEnv",
        )
