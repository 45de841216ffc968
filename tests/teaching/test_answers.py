"""Every exercise with code: the reference passes, a blank does not, typical mistakes are named."""

import pytest
from graded import SOURCES, complaint, exercises_of, link_rows, run

NUM_MISTAKES = 3


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_answers(path, tmp_path, monkeypatch):
    link_rows(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "exercises"}
    exercises = exercises_of(path)
    assert exercises
    for exercise in exercises:
        for source in exercise.given:
            run(source, names)
        blank = complaint(exercise.blank, exercise, names)
        assert isinstance(blank, NotImplementedError), f"{exercise.name}, blank: {blank!r}"
        assert len(exercise.mistakes) >= NUM_MISTAKES, exercise.name
        for mistake in exercise.mistakes:
            said = complaint(exercise.with_mistake(mistake), exercise, names)
            about = f"{exercise.name}, {mistake['why']}: {said!r}"
            assert isinstance(said, AssertionError) and mistake["says"] in str(said), about
        run(exercise.solution, names)
        run(exercise.check, names)
