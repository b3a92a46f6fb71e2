def draw(c,p): p.write_bytes(b"x")
