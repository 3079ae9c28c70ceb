"""Plan for 64 robots with random starts and goals on 10 m x 10 m, and save the plan, a picture and an animation.

    python -m examples.sixty_four_robots --seed 1

The planner `hybrid` begins with straight drives to the goals, and repairs those of the robots that meet.
"""

from __future__ import annotations

import sys

from examples.common import argument_parser, count, save_table

from d4orm_env import make_problem, verify
from d4orm_env.render import save_animation, save_picture
from d4orm_planners import make_planner


def main() -> int:
    """Plan, check and draw; the exit status is 1 if no solution was found."""
    parser = argument_parser(__doc__)
    parser.add_argument("--num-robots", "--robots", type=count, default=64)
    parser.add_argument("--seed", type=int, default=1, help="of the starts and goals, and of the planner")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds to plan")
    arguments = parser.parse_args()
    num_robots = min(arguments.num_robots, 12) if arguments.quick else arguments.num_robots
    size = 10.0 * (num_robots / 64) ** 0.5
    problem = make_problem("random", num_robots=num_robots, seed=arguments.seed, size=size)

    plan = make_planner("hybrid").solve(problem, seed=arguments.seed, time_limit=arguments.time_limit)
    rows = [
        {
            "iteration": record.iteration,
            "seconds": f"{record.wall_time:.2f}",
            "failed": record.num_failed,
            "within the margin": record.num_margin_violated,
            "not arrived": record.num_not_arrived,
        }
        for record in plan.history
    ]
    save_table(rows, arguments.out / "sixty_four_robots.csv")
    if not plan.solved:
        print(f"no solution after {plan.wall_time:.1f} s; try another --seed or a longer --time-limit")
        return 1

    report = verify(problem, plan.controls)
    print(f"{num_robots} robots on {size:.1f} m x {size:.1f} m: solved in {plan.wall_time:.2f} s")
    print(f"average travel time {plan.metrics['travel_time']:.2f} s, last arrival {plan.metrics['makespan']:.2f} s")
    print(f"verified: {report.ok}; smallest gap between robots {report.min_separation:.3f} m")
    plan.save(arguments.out / "sixty_four_robots.npz")
    save_picture(problem, plan.trajectory, arguments.out / "sixty_four_robots.png")
    frames = 20 if arguments.quick else 200
    save_animation(problem, plan.trajectory, arguments.out / "sixty_four_robots.gif", max_frames=frames)
    print(f"wrote sixty_four_robots.npz, .png and .gif to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
