from tests import shapes as shapes  # where pytest's option finds it
