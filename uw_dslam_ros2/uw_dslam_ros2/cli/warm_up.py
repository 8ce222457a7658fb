"""Compile the kernels once, so that nobody's first call waits for it."""


def main() -> None:
    """Run every kernel on something small; numba keeps the machine code on disk."""


if __name__ == "__main__":
    main()
