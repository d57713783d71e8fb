"""Many runs of the same structure as one program: replay and learners on the device, environments in processes."""
