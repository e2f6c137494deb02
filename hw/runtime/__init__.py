"""What all of hw uses: errors, bench time, keys, signals, optional libraries, rigid transforms."""
