"""A hand-written ``env.step`` loop: two policies in the same world, with the noise on the controls turned up.

    python -m examples.step_loop

Copy ``run`` to start an experiment of your own; ``d4orm_planners.run_episode`` is the same loop with a recording.
"""

from __future__ import annotations

from examples.common import argument_parser, save_table

from d4orm_env import navigation_v0
from d4orm_planners import make_policy


def run(policy_name: str, num_robots: int, noise: float, seed: int) -> tuple[int, int, float]:
    """One episode: robots that arrived, robots that touched something, and the team's mean return."""
    env = navigation_v0.parallel_env(scenario="circle", num_robots=num_robots, control_noise_std=noise)
    policy = make_policy(policy_name)

    observations, infos = env.reset(seed=seed)
    policy.reset(env, seed=seed)
    arrived: set[str] = set()
    touched: set[str] = set()
    team_return = 0.0
    while env.agents:
        acting = {agent: observations[agent] for agent in env.agents}
        actions = policy.act(acting, env.state())
        observations, rewards, _, _, infos = env.step(actions)
        arrived |= {agent for agent in infos if infos[agent]["arrived"]}
        touched |= {agent for agent in infos if infos[agent]["collided"]}
        team_return += sum(rewards.values()) / num_robots
    env.close()
    return len(arrived), len(touched), team_return


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--num-robots", "--robots", type=int, default=8)
    arguments = parser.parse_args()
    num_robots = 4 if arguments.quick else arguments.num_robots
    seeds = range(1 if arguments.quick else 5)
    noises = (0.0, 0.5) if arguments.quick else (0.0, 0.1, 0.2, 0.5, 1.0)
    rows = []
    for noise in noises:
        for name in ("d4orm", "go-to-goal"):
            episodes = [run(name, num_robots, noise, seed) for seed in seeds]
            robots = num_robots * len(episodes)
            success = sum(arrived == num_robots and touched == 0 for arrived, touched, _ in episodes)
            rows.append(
                {
                    "noise [m/s^2]": noise,
                    "policy": name,
                    "success": f"{success} of {len(episodes)}",
                    "arrived": f"{sum(episode[0] for episode in episodes) / robots:.0%}",
                    "touched something": f"{sum(episode[1] for episode in episodes) / robots:.0%}",
                    "return": f"{sum(episode[2] for episode in episodes) / len(episodes):.1f}",
                }
            )
    save_table(rows, arguments.out / "step_loop.csv")


if __name__ == "__main__":
    main()
