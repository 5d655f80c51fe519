"""What a diagnosis says to a person: verdict, what to do, what each effect is worth, what was not
determined; and one page of HTML with all of it (`page.py`). The text for the screen and
diagnosis.json say the same (`output.py`).
"""
