from play_pusht import over_episodes


def test_mean_over_episodes() -> None:
    assert over_episodes([0.25, 0.75]) == "0.500 [0.250, 0.750] over 2 episodes"
    assert over_episodes([0.5]) == "0.500 over 1 episodes"
