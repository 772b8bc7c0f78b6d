"""Features and matches by networks: kornia's, with weights from elsewhere."""
