"""Plan for the mixed team of ``scenarios/mixed_team.yaml``, check the plan, and save it, a picture and an animation.

python -m examples.mixed_team
"""

from __future__ import annotations

import sys
from pathlib import Path

from examples.common import argument_parser

from d4orm_env import load_problem, verify
from d4orm_env.render import save_animation, save_picture
from d4orm_planners import make_planner

SCENARIO = Path(__file__).with_name("scenarios") / "mixed_team.yaml"


def main() -> int:
    """Plan, check and draw; the exit status is 1 if no solution was found."""
    parser = argument_parser(__doc__)
    parser.add_argument("--scenario", type=Path, default=SCENARIO, help="a scenario file")
    parser.add_argument("--seed", type=int, default=2)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    problem = load_problem(arguments.scenario)
    plan = make_planner().solve(problem, seed=arguments.seed)
    if not plan.solved:
        failed = plan.history[-1].num_failed
        print(f"no solution after {plan.iterations} iterations ({failed} robots fail); try another --seed")
        return 1

    report = verify(problem, plan.controls)
    models = ", ".join(problem.team.models)
    print(f"{models}: solved after {plan.denoising_steps} denoising steps")
    print(f"average travel time {plan.metrics['travel_time']:.2f} s, last arrival {plan.metrics['makespan']:.2f} s")
    print(f"verified: {report.ok}; smallest gap between robots {report.min_separation:.3f} m")
    print(f"smallest gap to obstacles and bounds {report.min_clearance:.3f} m")

    plan.save(arguments.out / "mixed_team.npz")
    save_picture(problem, plan.trajectory, arguments.out / "mixed_team.png")
    save_animation(
        problem, plan.trajectory, arguments.out / "mixed_team.gif", max_frames=20 if arguments.quick else 400
    )
    print(f"wrote mixed_team.npz, .png and .gif to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
