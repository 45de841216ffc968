"""Settings of nbgrader for the course directory that the instructor's package is."""

c = get_config()  # noqa: F821 (nbgrader defines it)

c.CourseDirectory.course_id = "ipo"
c.ExecutePreprocessor.timeout = 300  # seconds for a cell
