"""What gradients of short windows are good for: three problems with and without them."""
