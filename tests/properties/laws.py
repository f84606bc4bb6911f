"""All laws, in one list."""

from . import laws_of_change, laws_of_form, laws_of_light, laws_of_place

LAWS = (*laws_of_light.LAWS, *laws_of_place.LAWS, *laws_of_form.LAWS, *laws_of_change.LAWS)
