"""``lerobot-bomb export``: files of results for a paper, a model card and the Hub's leaderboards."""

import argparse
from pathlib import Path

from lerobot_bomb.commands.arguments import add_names_flag, path_flag, switch
from lerobot_bomb.commands.results_files import check_outputs, names_of, read_together, tell_replaced
from lerobot_bomb.data.resumable import check_repo_id
from lerobot_bomb.files import file_names, written_whole
from lerobot_bomb.report.eval_info import eval_info_files
from lerobot_bomb.report.latex import latex_tables
from lerobot_bomb.results.groups import groups_of, policies_of

LATEX, MODEL_INDEX, EVAL_RESULTS = "table.tex", "model-index.yaml", ".eval_results/lerobot_bomb.yaml"
BENCHMARK = "benchmark"  # folder of the benchmark's own files


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add("paths", nargs="+", type=path_flag, metavar="FILE", help="files of --env.results_path")
    add("--output", type=path_flag, default=Path("outputs/export"), help="folder (default: outputs/export)")
    add_names_flag(parser)
    add(
        "--benchmark_id",
        type=_hub_id,
        metavar="USER/NAME",
        help=f"the benchmark's dataset on the Hub, which {EVAL_RESULTS} must name; its own files go into "
        f"{BENCHMARK}/ (default: no such files)",
    )
    about = "also write eval_info.json with seeds and run_meta.json, for tools that pair episodes"
    add("--eval_info", **switch(), help=about)


def _hub_id(text: str) -> str:
    try:
        check_repo_id(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} must be USER/NAME") from None
    return text


def run(args: argparse.Namespace) -> int:
    """Write LaTeX tables and, for each policy, the files of its Hub repository; print the paths."""
    # huggingface_hub takes a second
    from lerobot_bomb.hub.benchmark import benchmark_files
    from lerobot_bomb.hub.evaluations import (
        check_one_rate_each,
        check_policies_compare,
        eval_results_yaml,
        model_index_yaml,
    )

    records = [record for file in read_together(args.paths) for record in file.records]
    groups = groups_of(records, names_of(args.names, records))
    tell_replaced(groups)
    contents = {args.output / LATEX: latex_tables(groups)}
    policies = policies_of(groups)
    _, _, *names = file_names([LATEX, BENCHMARK, *(each.short_name for each in policies)])
    for policy in policies:
        check_one_rate_each(policy.groups)
    if args.eval_info or args.benchmark_id is not None:
        check_policies_compare(groups)
    for name, policy in zip(names, policies, strict=True):
        contents[args.output / name / MODEL_INDEX] = model_index_yaml(name, policy.groups)
        if args.eval_info:
            files = eval_info_files(policy.groups)
            contents |= {args.output / name / path: content for path, content in files.items()}
        if args.benchmark_id is not None:
            contents[args.output / name / EVAL_RESULTS] = eval_results_yaml(args.benchmark_id, policy.groups)
    if args.benchmark_id is not None:
        files = benchmark_files(args.benchmark_id, groups)
        contents |= {args.output / BENCHMARK / name: content for name, content in files.items()}
    check_outputs(args.paths, contents)
    for path, content in contents.items():
        with written_whole(path) as (unfinished,):
            unfinished.write_text(content)
    print(*contents, sep="\n")
    return 0
