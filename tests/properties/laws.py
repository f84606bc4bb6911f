"""All laws, in one list."""

from . import laws_of_change, laws_of_form, laws_of_light, laws_of_place, laws_of_programs

ROOMS = laws_of_light, laws_of_place, laws_of_form, laws_of_change, laws_of_programs
LAWS = tuple(law for room in ROOMS for law in room.LAWS)
