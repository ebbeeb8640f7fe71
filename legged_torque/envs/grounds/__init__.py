"""The settings of each ground, one module each; they name no robot and no approach."""
