"""What bodies and obstacles look like: coloured triangles, planes and joint marks as plain arrays. Imports `contact` and `tree`,
for the shapes; a scene names its visuals with it, and `records` keep them."""
