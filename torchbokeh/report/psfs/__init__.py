"""How well sparse point-spread functions do."""
