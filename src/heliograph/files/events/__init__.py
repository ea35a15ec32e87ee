"""Events of a recording: measurements that came one by one, each with its time, and the rows that they make."""
