"""Runs over many flights at once.

(The functions are of this module, which the other processes import.)
"""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools import cli, parallel


def times_ten(number):
    time.sleep(0.02 * (number % 3))  # so that they do not end in the order in which they began
    return 10 * number


def process(_):
    return os.getpid()


def refuse_three(number):
    if number == 3:
        raise InputError("number: 3 is too few; give more.")
    return number


def resolution(_):
    """Of pictures, as matplotlib is set where it is imported."""
    import matplotlib

    return matplotlib.rcParams["savefig.dpi"]


@pytest.fixture
def importable(monkeypatch):
    """This module can be imported in processes that are started now."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))


@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_items(importable, count, jobs):
    assert list(parallel.over(times_ten, range(count), jobs)) == [10 * k for k in range(count)]


def test_the_first_is_done_here_and_the_others_elsewhere(importable):
    here, *others = parallel.over(process, range(6), 2)
    assert here == os.getpid() and here not in others and 1 <= len(set(others)) <= 2


def test_what_draws_in_other_processes_takes_no_settings_of_the_present_folder(
    importable, tmp_path, monkeypatch
):
    (tmp_path / "matplotlibrc").write_text("savefig.dpi: 100000\n")
    monkeypatch.chdir(tmp_path)
    assert list(parallel.over(resolution, range(4), 2))[1:] == ["figure"] * 3


def test_one_item_and_one_job_need_no_other_process():
    assert list(parallel.over(process, ["only"], 2)) == [os.getpid()]
    assert set(parallel.over(process, range(4), 1)) == {os.getpid()}


def test_results_come_while_others_are_still_to_be_made():
    seen = []
    results = parallel.over(seen.append, range(5), 1)
    next(results)
    assert seen == [0]


@pytest.mark.parametrize("jobs", [1, 2])
def test_bad_input_found_elsewhere_is_the_same_sentence(importable, jobs, capsys):
    def command(args):
        for result in parallel.over(refuse_three, range(6), jobs):
            print(result)

    assert cli.run(command, cli.parser("count", "Count."), []) == 2
    out, err = capsys.readouterr()
    assert out.split() == ["0", "1", "2"]
    assert err == "count: error: number: 3 is too few; give more.\n"


def test_an_interrupt_ends_all_of_it_without_a_word(importable):
    code = (
        "import sys, time; from uwb_tdoa_tools import cli, parallel\n"
        "def work(args):\n"
        "    for number in parallel.over(time.sleep, [0.0] + 200 * [0.2], 2): print('done', "
        "flush=True)\n"
        "sys.exit(cli.run(work, cli.parser('work', 'Work.'), []))"
    )
    work = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    for _ in range(3):
        assert (
            work.stdout.readline() == b"done\n"
        )  # the first by itself, the others by its children
    os.killpg(work.pid, signal.SIGINT)  # as a terminal does
    _, err = work.communicate(timeout=120)  # returns when the children have closed their ends, too
    assert work.returncode == 130 and all(
        b" of 201 flights done, " in line for line in err.splitlines()
    )


def test_a_folder_of_flights_does_not_say_what_the_others_run(tmp_path, importable):
    """Python looks for modules where it starts, if it is told to by -m, as joblib does: whatever
    lies there would run.
    """
    for name in ("joblib", "struct", "selectors", "runpy", "pickle"):
        (tmp_path / f"{name}.py").write_text(
            f"open('{tmp_path}/ran', 'w').close(); raise SystemExit(1)"
        )
    (tmp_path / "work.py").write_text(
        "import os, sys; sys.path.pop(0)\n"
        "from uwb_tdoa_tools import parallel\n"
        "print([*parallel.over(os.path.abspath, ['a', 'b', 'c', 'd'], 2)])\n"
    )
    ended = subprocess.run(
        [sys.executable, "work.py"], cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert ended.stdout == f"{[str(tmp_path / name) for name in 'abcd']}\n", ended.stderr
    assert not (tmp_path / "ran").exists()


def options(*argv):
    parser = cli.parser("tool", "A tool.")
    parser.add_argument("--out")
    parallel.add_options(parser)
    return parser.parse_args(argv)


def test_options():
    assert vars(options()) == {"out": None, "jobs": None, "dask": None}
    assert options("--jobs", "3").jobs == 3
    assert options("--dask", "tcp://here:1").dask == "tcp://here:1"


def test_few_items_are_done_in_one_process_unless_more_are_asked_for():
    assert parallel.workers_for(options(), 4, 5) == (1, None)
    assert parallel.workers_for(options(), 5, 5) == (min(parallel.cpu_count(), 5), None)
    assert parallel.workers_for(options("--jobs", "2"), 4, 5) == (2, None)
    assert parallel.workers_for(options("--dask", "tcp://here:1"), 4, 5) == (None, "tcp://here:1")


def test_other_calls_have_the_same_processes(importable):
    seen = {
        number
        for count in (6, 3, 8)
        for number in list(parallel.over(process, range(count), 2))[1:]
    }
    assert 1 <= len(seen) <= 2


@pytest.mark.parametrize(
    "argv, sentence",
    [
        (["--jobs", "0"], "'0' is not a whole number above 0"),
        (["--jobs", "two"], "'two' is not a whole number above 0"),
        (["--jobs", "2", "--dask", "tcp://here:1"], "not allowed with"),
    ],
)
def test_bad_options(argv, sentence, capsys):
    with pytest.raises(SystemExit):
        options(*argv)
    assert sentence in capsys.readouterr().err


def test_without_dask_it_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    with pytest.raises(InputError, match="--dask: needs dask.distributed, which is not installed"):
        list(parallel.over(times_ten, [1, 2], dask="tcp://127.0.0.1:1"))


def test_an_address_that_is_none(monkeypatch):
    pytest.importorskip("dask.distributed")
    with pytest.raises(InputError, match="--dask: no scheduler answers at nowhere"):
        list(parallel.over(times_ten, [1, 2], dask="nowhere"))


@pytest.mark.parametrize(
    ("address", "said"),
    [("tcp://10.0.0.1:8786", 1), ("ucx://10.0.0.2:1", 1), ("tls://10.0.0.1:8786", 0)],
)
def test_whom_a_connection_trusts_is_said_once(address, said, capsys):
    parallel._say_whom_it_trusts.cache_clear()
    for _ in range(2):
        parallel._say_whom_it_trusts(address)
    err = capsys.readouterr().err
    assert (
        err.count(f"--dask: {address} is not encrypted: whoever reaches it")
        == err.count("\n")
        == said
    )


@pytest.mark.parametrize("encrypted", [False, True])
def test_a_cluster_is_asked_by_the_certificates_of_dask(importable, encrypted, monkeypatch, capsys):
    distributed = pytest.importorskip("dask.distributed")
    dask = pytest.importorskip("dask")
    if encrypted:
        pytest.importorskip("cryptography")
    security = distributed.Security.temporary() if encrypted else None
    parallel._say_whom_it_trusts.cache_clear()
    with distributed.LocalCluster(
        1, threads_per_worker=1, dashboard_address=None, security=security
    ) as cluster:
        address = cluster.scheduler_address
        if encrypted:
            with pytest.raises(InputError, match="no scheduler answers"):  # a stranger without them
                list(parallel.over(times_ten, range(3), dask=address))
            tls = {
                "ca-file": security.tls_ca_file,
                "client.cert": security.tls_client_cert,
                "client.key": security.tls_client_key,
            }
            with dask.config.set(
                {f"distributed.comm.tls.{name}": value for name, value in tls.items()}
            ):
                assert list(parallel.over(times_ten, range(3), dask=address)) == [0, 10, 20]
        else:
            assert list(parallel.over(times_ten, range(3), dask=address)) == [0, 10, 20]
    assert ("is not encrypted" in capsys.readouterr().err) != encrypted


def test_on_a_dask_cluster(importable):
    distributed = pytest.importorskip("dask.distributed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        assert list(parallel.over(times_ten, range(7), dask=address)) == [10 * k for k in range(7)]
        here, *others = parallel.over(process, range(6), dask=address)
        assert here == os.getpid() and here not in others
        with pytest.raises(InputError, match="3 is too few"):
            list(parallel.over(refuse_three, range(6), dask=address))
