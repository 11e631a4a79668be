"""Many runs: drift of a block, control charts, benches compared, what the runs of a bench tell of it."""
