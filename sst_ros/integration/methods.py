# SPDX-License-Identifier: Apache-2.0
"""Coefficients of the methods, as data.

Sources: RK4, Kutta 1901. Dormand-Prince 5(4), J. Comput. Appl. Math. 6 (1980) 19-26.
DOP853, Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, 2nd ed.,
section II.10. Rodas5P, Steinebach, BIT Numerical Mathematics 63 (2023) 27.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple


class DenseOutput(NamedTuple):
    """The solution inside of a step, by further stages that are taken after it.

    The first of them is the end of the step. With s = x / h, u = 1 - s,
    slopes k, and states y_0 and y_1 at both ends the solution at x is

        y_0 + s (F_0 + u (F_1 + s (F_2 + u (F_3 + s (F_4 + ...)))))
        F_0 = y_1 - y_0,  F_1 = h k_0 - F_0,  F_2 = F_0 - F_1 - h k_1

    where k_1 is the slope at the end and F_3, .. are h times weighted sums of all k.
    """

    a: tuple[tuple[float, ...], ...]  # of the stages behind the one at the end
    c: tuple[float, ...]  # their nodes
    weights: tuple[tuple[float, ...], ...]  # of all slopes in F_3, F_4, ..


@dataclass(frozen=True, repr=False)
class Tableau:
    """The coefficients of an explicit Runge-Kutta method."""

    name: str
    order: int  # of the solution that goes on
    a: tuple[tuple[float, ...], ...]  # lower triangle, row i has i entries
    b: tuple[float, ...]  # weights of the solution
    c: tuple[float, ...]  # nodes
    error: tuple[float, ...] = ()  # weights of the error estimate; none for half steps
    error_order: int = 0  # p of the estimate, which shrinks like h^(p+1)
    # weights of a second estimate that scales the first (DOP853)
    damping: tuple[float, ...] = ()
    dense: DenseOutput | None = None  # inside of a step

    def __repr__(self) -> str:
        """Return the name alone: the numbers would fill a page of `help`."""
        return f"{type(self).__name__}({self.name!r})"

    def __reduce__(self) -> Any:
        """Copy a method of `METHODS` as itself: methods are compared by identity."""
        return _reduce(self)


def _row(entries: str) -> tuple[float, ...]:
    return tuple(float(Fraction(entry)) for entry in entries.split())


RK4 = Tableau(
    name="rk4",
    order=4,
    a=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
    b=_row("1/6 1/3 1/3 1/6"),
    c=(0.0, 0.5, 0.5, 1.0),
    error_order=4,
)

DORMAND_PRINCE = Tableau(
    name="dopri5",
    order=5,
    a=(
        (),
        _row("1/5"),
        _row("3/40 9/40"),
        _row("44/45 -56/15 32/9"),
        _row("19372/6561 -25360/2187 64448/6561 -212/729"),
        _row("9017/3168 -355/33 46732/5247 49/176 -5103/18656"),
        _row("35/384 0 500/1113 125/192 -2187/6784 11/84"),
    ),
    b=_row("35/384 0 500/1113 125/192 -2187/6784 11/84 0"),
    c=_row("0 1/5 3/10 4/5 8/9 1 1"),
    error=_row("71/57600 0 -71/16695 71/1920 -17253/339200 22/525 -1/40"),
    error_order=4,
)

DOP853 = Tableau(
    name="dop853",
    order=8,
    a=(
        (),
        _row("0.05260015195876773"),
        _row("0.0197250569845379 0.0591751709536137"),
        _row("0.02958758547680685 0 0.08876275643042054"),
        _row("0.2413651341592667 0 -0.8845494793282861 0.924834003261792"),
        _row("0.037037037037037035 0 0 0.17082860872947386 0.12546768756682242"),
        _row("0.037109375 0 0 0.17025221101954405 0.06021653898045596 -0.017578125"),
        _row(
            "0.03709200011850479 0 0 0.17038392571223998 0.10726203044637328 "
            "-0.015319437748624402 0.008273789163814023"
        ),
        _row(
            "0.6241109587160757 0 0 -3.3608926294469414 -0.868219346841726"
            " 27.59209969944671 20.154067550477894 -43.48988418106996"
        ),
        _row(
            "0.47766253643826434 0 0 -2.4881146199716677 -0.590290826836843"
            " 21.230051448181193 15.279233632882423 -33.28821096898486"
            " -0.020331201708508627"
        ),
        _row(
            "-0.9371424300859873 0 0 5.186372428844064 1.0914373489967295"
            " -8.149787010746927 -18.52006565999696 22.739487099350505"
            " 2.4936055526796523 -3.0467644718982196"
        ),
        _row(
            "2.273310147516538 0 0 -10.53449546673725 -2.0008720582248625"
            " -17.9589318631188 27.94888452941996 -2.8589982771350235 -8.87285693353063"
            " 12.360567175794303 0.6433927460157636"
        ),
    ),
    b=_row(
        "0.054293734116568765 0 0 0 0 4.450312892752409 1.8915178993145003"
        " -5.801203960010585 0.3111643669578199 -0.1521609496625161 0.20136540080403034"
        " 0.04471061572777259"
    ),
    c=_row(
        "0 0.05260015195876773 0.0789002279381516 0.1183503419072274 0.2816496580927726"
        " 0.3333333333333333 0.25 0.3076923076923077 0.6512820512820513 0.6"
        " 0.8571428571428571 1"
    ),
    error=_row(
        "0.01312004499419488 0 0 0 0 -1.2251564463762044 -0.4957589496572502"
        " 1.6643771824549864 -0.35032884874997366 0.3341791187130175"
        " 0.08192320648511571 -0.022355307863886294"
    ),
    error_order=7,
    damping=_row(
        "-0.18980075407240762 0 0 0 0 4.450312892752409 1.8915178993145003"
        " -5.801203960010585 -0.4226823213237919 -0.1521609496625161"
        " 0.20136540080403034 0.02265179219836082"
    ),
    dense=DenseOutput(
        a=(
            _row(
                "0.056167502283047954 0 0 0 0 0 0.25350021021662483 "
                "-0.2462390374708025 -0.12419142326381637 0.15329179827876568 "
                "0.00820105229563469 0.007567897660545699 -0.008298"
            ),
            _row(
                "0.03183464816350214 0 0 0 0 0.028300909672366776 0.053541988307438566 "
                "-0.05492374857139099 0 0 -0.00010834732869724932 "
                "0.0003825710908356584 -0.00034046500868740456 0.1413124436746325"
            ),
            _row(
                "-0.42889630158379194 0 0 0 0 -4.697621415361164 7.683421196062599 "
                "4.06898981839711 0.3567271874552811 0 0 0 -0.0013990241651590145 "
                "2.9475147891527724 -9.15095847217987"
            ),
        ),
        c=_row("0.1 0.2 7/9"),
        weights=(
            _row(
                "-8.428938276109013 0 0 0 0 0.5667149535193777 -3.0689499459498917 "
                "2.38466765651207 2.117034582445028 -0.871391583777973 "
                "2.2404374302607883 0.6315787787694688 -0.08899033645133331 "
                "18.148505520854727 -9.194632392478356 -4.436036387594894"
            ),
            _row(
                "10.427508642579134 0 0 0 0 242.28349177525817 165.20045171727028 "
                "-374.5467547226902 -22.113666853125306 7.733432668472264 "
                "-30.674084731089398 -9.332130526430229 15.697238121770845 "
                "-31.139403219565178 -9.35292435884448 35.81684148639408"
            ),
            _row(
                "19.985053242002433 0 0 0 0 -387.0373087493518 -189.17813819516758 "
                "527.8081592054236 -11.57390253995963 6.8812326946963 "
                "-1.0006050966910838 0.7777137798053443 -2.778205752353508 "
                "-60.19669526123412 84.32040550667716 11.99229113618279"
            ),
            _row(
                "-25.69393346270375 0 0 0 0 -154.18974869023643 -231.5293791760455 "
                "357.6391179106141 93.40532418362432 -37.45832313645163 "
                "104.0996495089623 29.8402934266605 -43.53345659001114 "
                "96.32455395918828 -39.17726167561544 -149.72683625798564"
            ),
        ),
    ),
)


@dataclass(frozen=True)
class Rosenbrock:
    """The coefficients of a linearly implicit method in the form without products J k.

    Its last stage is its error estimate, and the argument of that stage the embedded
    solution.
    """

    name: str
    order: int  # of the solution that goes on
    error_order: int  # of the error estimate
    gamma: float  # of the matrix 1 / (gamma h) - J, which all stages share
    a: tuple[tuple[float, ...], ...]  # of the stages in the arguments
    c: tuple[tuple[float, ...], ...]  # of the stages in the right-hand sides, over h
    alpha: tuple[float, ...]  # nodes
    d: tuple[float, ...]  # of the derivative by time

    def __reduce__(self) -> Any:
        """Copy a method of `METHODS` as itself."""
        return _reduce(self)


_RODAS5P_LAST = _row(
    "-7.502846399306121 2.561846144803919 -11.627539656261098 -0.18268767659942256 "
    "0.030198172008377946"
)
"""Weights of the first five stages in the arguments of the last three.

The argument of each of these is the one before it plus the stage of that.
"""

RODAS5P = Rosenbrock(
    name="rodas5p",
    order=5,
    error_order=4,
    gamma=0.21193756319429014,
    a=(
        (),
        _row("3"),
        _row("2.849394379747939 0.45842242204463923"),
        _row("-6.954028509809101 2.489845061869568 -10.358996098473584"),
        _row(
            "2.8029986275628964 0.5072464736228206 -0.3988312541770524"
            " -0.04721187230404641"
        ),
        _RODAS5P_LAST,
        (*_RODAS5P_LAST, 1.0),
        (*_RODAS5P_LAST, 1.0, 1.0),
    ),
    c=(
        (),
        _row("-14.155112264123755"),
        _row("-17.97296035885952 -2.859693295451294"),
        _row("147.12150275711716 -1.41221402718213 71.68940251302358"),
        _row(
            "165.43517024871676 -0.4592823456491126 42.90938336958603"
            " -5.961986721573306"
        ),
        _row(
            "24.854864614690072 -3.0009227002832186 47.4931110020768 5.5814197821558125"
            " -0.6610691825249471"
        ),
        _row(
            "30.91273214028599 -3.1208243349937974 77.79954646070892 34.28646028294783 "
            "-19.097331116725623 -28.087943162872662"
        ),
        _row(
            "37.80277123390563 -3.2571969029072276 112.26918849496327 66.9347231244047 "
            "-40.06618937091002 -54.66780262877968 -9.48861652309627"
        ),
    ),
    alpha=_row(
        "0 0.6358126895828704 0.4095798393397535 0.9769306725060716 0.4288403609558664"
        " 1 1 1"
    ),
    d=_row(
        "0.21193756319429014 -0.42387512638858027 -0.3384627126235924"
        " 1.8046452872882734 2.325825639765069 0 0 0"
    ),
)

Method = Tableau | Rosenbrock

AUTO = "auto"
"""Changes between methods as the motion asks for."""

METHODS: dict[str, Method] = {
    method.name: method for method in (RK4, DORMAND_PRINCE, DOP853, RODAS5P)
}


def _reduce(method: Method) -> Any:
    """Return how a method is copied: by its name if it is one of METHODS."""
    if METHODS.get(method.name) is method:
        return _find, (method.name,)
    return type(method), tuple(vars(method).values())


def _find(name: str) -> Method:
    return METHODS[name]
