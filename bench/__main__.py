"""`python -m bench` is the program `bench`."""

if __name__ == "__main__":
    from bench.cli.program import main

    main()
