"""What to train and where: the plan of a grid, the processes that train it, the time that it takes."""
