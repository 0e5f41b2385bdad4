"""What people look like from cameras that stand still: ellipsoids on a floor (Kato, Nakazawa, Inokuchi 1999)."""
