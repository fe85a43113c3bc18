"""What is put right in a skeleton: false ties, backward starts, kinks."""
