"""A second opinion in the space of forces: does the logged force of every joint suit the motion that it made?"""
