"""On the path of a hold under test: SIGUSR1 makes whatever its main thread does hang for some
seconds.
"""

import os
import signal
import time

signal.signal(signal.SIGUSR1, lambda number, frame: time.sleep(float(os.environ["HANG_S"])))
