"""What a UR controller must show before the first motion, and what a person does about it."""
