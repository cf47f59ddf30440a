from benchmarks.blind.run import main

if __name__ == "__main__":
    main()
