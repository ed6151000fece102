"""The commands of `mapfusion`: load, compute, show. Heavy imports sit inside of them."""
