"""The paper's way to a style: pictures in the style teach the field's colours, view by view."""
