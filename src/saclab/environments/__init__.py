"""The only place that knows Gymnasium and MuJoCo."""
