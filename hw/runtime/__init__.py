"""What all of hw uses: errors, bench time, keys, signals, processes, libraries, transforms."""
