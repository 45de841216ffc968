"""What students get from the site."""

from graded import leaks


def test_the_site_offers_the_students_package_and_no_solution(built_site):
    assert len(list(built_site.glob("_downloads/*/ipo-exercises.zip"))) == 1
    assert leaks(built_site) == []
