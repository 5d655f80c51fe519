"""Does `check` name what was put into a recording, and is it silent where nothing was?"""
