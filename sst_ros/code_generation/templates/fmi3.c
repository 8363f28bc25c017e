/*
 * Functional Mock-up Interface 3.0 for the equations in {{ name }}.c.
 *
 * Model Exchange gives the derivative of the state. Co-Simulation integrates it by DOP853
 * (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section II.10),
 * with steps that an error estimate controls, or with steps of the parameter `step`.
 * Inputs are held over a communication step.
 */
#include "{{ name }}.h"
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

#define TOKEN "{{ token }}"

enum {
    STATES = {{ states }},
    INPUTS = {{ inputs }},
    OUTPUTS = 20,
    PARAMETERS = {{ parameters|length }},
    /* Value references. */
    TIME = 0,
    FIRST_STATE = 1,
    FIRST_DERIVATIVE = FIRST_STATE + STATES,
    FIRST_INPUT = FIRST_DERIVATIVE + STATES,
    FIRST_OUTPUT = FIRST_INPUT + INPUTS,
    FIRST_PARAMETER = FIRST_OUTPUT + OUTPUTS,
    STEP = FIRST_PARAMETER + PARAMETERS,
    END = STEP + 1,
    STAGES = {{ stages }}
};

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status;
typedef uint32_t Reference;
typedef void (*LogMessage)(void *environment, Status status, const char *category,
                           const char *message);

typedef struct {
    double time;
    double state[STATES];
    double input[INPUTS];
    double parameters[PARAMETERS + 1];
    double step; /* length of a fixed step [s]; 0 for error control */
    double tolerance;
    double next; /* length of the next step under error control [s] */
} Numbers;

typedef struct {
    Numbers numbers;
    void *environment;
    LogMessage log;
} Instance;

/* Coefficients of the method. */

static const double NODES[STAGES][STAGES] = {
{% for row in stage_rows %}
    { {{ row|join(", ") }} },
{% endfor %}
};
static const double WEIGHTS[STAGES] = { {{ weights|join(", ") }} };
static const double FIFTH[STAGES] = { {{ fifth|join(", ") }} };
static const double THIRD[STAGES] = { {{ third|join(", ") }} };

static const double LEAST_STEP = 1e-14; /* relative to the time [s] */
static const double DEFAULT_TOLERANCE = 1e-9;
static const double FIRST_STEP = 1e-3; /* [s] */

static Status report(const Instance *instance, Status status, const char *message)
{
    if (instance->log != NULL) {
        instance->log(instance->environment, status, "logStatusError", message);
    }
    return status;
}

static Status refuse(void *given, const char *message)
{
    return report(given, ERROR, message);
}

static void reset(Numbers *numbers)
{
    memset(numbers, 0, sizeof *numbers);
    memcpy(numbers->state, {{ name }}_initial_state, sizeof numbers->state);
{% if parameters %}
    memcpy(numbers->parameters, {{ name }}_scene_parameters, PARAMETERS * sizeof(double));
{% endif %}
    numbers->tolerance = DEFAULT_TOLERANCE;
    numbers->next = FIRST_STEP;
}

static void derive(const Numbers *numbers, const double state[STATES], double rate[STATES])
{
    double acting[INPUTS];
    memcpy(acting, numbers->input, sizeof acting);
{% if torque_limit %}
    for (int i = 0; i < 3; i++) {
        acting[i] = fmin(fmax(acting[i], -{{ torque_limit }}), {{ torque_limit }});
    }
{% endif %}
    {{ name }}_derivative(state, acting{{ ", acting + 3" if inputs > 3 }}{{ ", numbers->parameters" if parameters }}, rate);
}

static bool are_finite(const double *values, size_t count)
{
    for (size_t i = 0; i < count; i++) {
        if (!isfinite(values[i])) {
            return false;
        }
    }
    return true;
}

/* Do a step of h; return the error relative to the tolerance, infinite where there is none. */
static double attempt(const Numbers *numbers, double h, double end[STATES])
{
    double slopes[STAGES][STATES], at[STATES];
    for (int stage = 0; stage < STAGES; stage++) {
        for (int i = 0; i < STATES; i++) {
            double sum = 0.0;
            for (int j = 0; j < stage; j++) {
                sum += NODES[stage][j] * slopes[j][i];
            }
            at[i] = numbers->state[i] + h * sum;
        }
        derive(numbers, at, slopes[stage]);
    }
    double rate = 1e-3 / h, torque = 1e-300; /* what an error is relative to */
    for (int i = 0; i < STATES; i++) {
        double sum = 0.0;
        for (int j = 0; j < STAGES; j++) {
            sum += WEIGHTS[j] * slopes[j][i];
        }
        end[i] = numbers->state[i] + h * sum;
        if (i >= 7) {
            torque = fmax(torque, fmax(fabs(end[i]), fabs(numbers->state[i])));
        } else if (i >= 4) {
            rate = fmax(rate, fmax(fabs(end[i]), fabs(numbers->state[i])));
        }
    }
    double fifth = 0.0, third = 0.0;
    for (int i = 0; i < STATES; i++) {
        double five = 0.0, three = 0.0, size = i < 4 ? 1.0 : i < 7 ? rate : torque;
        for (int j = 0; j < STAGES; j++) {
            five += FIFTH[j] * slopes[j][i];
            three += THIRD[j] * slopes[j][i];
        }
        fifth += five * five / (size * size);
        third += three * three / (size * size);
    }
    if (!are_finite(end, STATES) || !isfinite(fifth + third)) {
        return INFINITY;
    }
    double whole = fifth + 0.01 * third;
    return whole > 0.0 ? h * fifth / sqrt(whole) / numbers->tolerance : 0.0;
}

static void accept(Numbers *numbers, double end[STATES])
{
    double square = 0.0;
    for (int i = 0; i < 4; i++) {
        square += end[i] * end[i];
    }
    for (int i = 0; i < 4; i++) {
        end[i] /= sqrt(square);
    }
    memcpy(numbers->state, end, STATES * sizeof(double));
}

/* Integrate over an interval [s]; false where no step resolves the motion. */
static bool integrate(Numbers *numbers, double interval)
{
    double end[STATES], done = 0.0;
    if (numbers->step > 0.0) {
        double count = fmax(ceil(interval / numbers->step - 1e-9), 1.0);
        for (double i = 0.0; i < count; i += 1.0) {
            if (attempt(numbers, interval / count, end) == INFINITY) {
                return false;
            }
            accept(numbers, end);
        }
        return true;
    }
    while (done < interval) {
        double left = interval - done, h = numbers->next;
        bool last = h * 1.001 >= left;
        h = last ? left : h;
        double error = attempt(numbers, h, end);
        double factor = fmin(fmax(0.9 * pow(error, -0.125), 0.2), 5.0);
        if (error > 1.0) {
            numbers->next = h * fmin(factor, 1.0);
            if (numbers->next < LEAST_STEP * fmax(fabs(numbers->time), interval)) {
                return false;
            }
            continue;
        }
        accept(numbers, end);
        numbers->next = last ? fmax(numbers->next, h * factor) : h * factor;
        done = last ? interval : done + h;
    }
    return true;
}

/* Life of an instance. */

EXPORT const char *fmi3GetVersion(void)
{
    return "3.0";
}

static void *instantiate(const char *token, void *environment, LogMessage log)
{
    if (token == NULL || strcmp(token, TOKEN) != 0) {
        if (log != NULL) {
            log(environment, ERROR, "logStatusError", "the token is that of another unit");
        }
        return NULL;
    }
    Instance *made = malloc(sizeof *made);
    if (made != NULL) {
        reset(&made->numbers);
        made->environment = environment;
        made->log = log;
    }
    return made;
}

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token,
                                          const char *resources, bool visible, bool logging,
                                          void *environment, LogMessage log)
{
    (void)name, (void)resources, (void)visible, (void)logging;
    return instantiate(token, environment, log);
}

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token,
                                         const char *resources, bool visible, bool logging,
                                         bool events, bool early, const Reference required[],
                                         size_t count, void *environment, LogMessage log,
                                         void (*update)(void))
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)required, (void)count, (void)update;
    return instantiate(token, environment, log);
}

EXPORT void *fmi3InstantiateScheduledExecution(const char *name, const char *token,
                                               const char *resources, bool visible,
                                               bool logging, void *environment,
                                               LogMessage log, void (*update)(void),
                                               void (*lock)(void), void (*unlock)(void))
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging;
    (void)update, (void)lock, (void)unlock;
    if (log != NULL) {
        log(environment, ERROR, "logStatusError", "there is no scheduled execution");
    }
    return NULL;
}

EXPORT void fmi3FreeInstance(void *given)
{
    free(given);
}

EXPORT Status fmi3EnterInitializationMode(void *given, bool defined, double tolerance,
                                          double start, bool ends, double stop)
{
    Instance *instance = given;
    (void)ends, (void)stop;
    if (defined && tolerance > 0.0) {
        instance->numbers.tolerance = tolerance;
    }
    instance->numbers.time = start;
    return OK;
}

EXPORT Status fmi3Reset(void *given)
{
    reset(&((Instance *)given)->numbers);
    return OK;
}

#define NOTHING_TO_DO(name)          \
    EXPORT Status name(void *given)  \
    {                                \
        (void)given;                 \
        return OK;                   \
    }

NOTHING_TO_DO(fmi3ExitInitializationMode)
NOTHING_TO_DO(fmi3EnterEventMode)
NOTHING_TO_DO(fmi3EnterContinuousTimeMode)
NOTHING_TO_DO(fmi3EnterStepMode)
NOTHING_TO_DO(fmi3EnterConfigurationMode)
NOTHING_TO_DO(fmi3ExitConfigurationMode)
NOTHING_TO_DO(fmi3EvaluateDiscreteStates)
NOTHING_TO_DO(fmi3Terminate)

EXPORT Status fmi3SetDebugLogging(void *given, bool logging, size_t count,
                                  const char *const categories[])
{
    (void)given, (void)logging, (void)count, (void)categories;
    return OK;
}

/* Numbers. */

EXPORT Status fmi3GetFloat64(void *given, const Reference references[], size_t count,
                             double values[], size_t size)
{
    const Instance *instance = given;
    const Numbers *numbers = &instance->numbers;
    double all[END];
    bool derived = false, evaluated = false;
    if (size < count) {
        return refuse(given, "too few values are asked for");
    }
    all[TIME] = numbers->time;
    memcpy(all + FIRST_STATE, numbers->state, sizeof numbers->state);
    memcpy(all + FIRST_INPUT, numbers->input, sizeof numbers->input);
    memcpy(all + FIRST_PARAMETER, numbers->parameters, PARAMETERS * sizeof(double));
    all[STEP] = numbers->step;
    for (size_t i = 0; i < count; i++) {
        Reference reference = references[i];
        if (reference >= END) {
            return refuse(given, "there is no such variable");
        }
        if (!derived && reference >= FIRST_DERIVATIVE && reference < FIRST_INPUT) {
            derive(numbers, numbers->state, all + FIRST_DERIVATIVE);
            derived = true;
        }
        if (!evaluated && reference >= FIRST_OUTPUT && reference < FIRST_PARAMETER) {
            {{ name }}_joints(numbers->state{{ ", numbers->parameters" if parameters }}, all + FIRST_OUTPUT);
            {{ name }}_energies(numbers->state{{ ", numbers->parameters" if parameters }}, all + FIRST_OUTPUT + 18);
            evaluated = true;
        }
        values[i] = all[reference];
    }
    if (!are_finite(values, count)) {
        return report(instance, DISCARD, "a variable is not finite: serial singularity");
    }
    return OK;
}

EXPORT Status fmi3SetFloat64(void *given, const Reference references[], size_t count,
                             const double values[], size_t size)
{
    Numbers *numbers = &((Instance *)given)->numbers;
    if (size < count || !are_finite(values, count)) {
        return refuse(given, "values must be finite numbers, one a variable");
    }
    for (size_t i = 0; i < count; i++) {
        Reference reference = references[i];
        if (reference >= FIRST_STATE && reference < FIRST_DERIVATIVE) {
            numbers->state[reference - FIRST_STATE] = values[i];
        } else if (reference >= FIRST_INPUT && reference < FIRST_OUTPUT) {
            numbers->input[reference - FIRST_INPUT] = values[i];
        } else if (reference >= FIRST_PARAMETER && reference < STEP) {
            numbers->parameters[reference - FIRST_PARAMETER] = values[i];
        } else if (reference == STEP && values[i] >= 0.0) {
            numbers->step = values[i];
        } else {
            return refuse(given, "a variable cannot be set to this value");
        }
    }
    return OK;
}

#define NO_VARIABLES(name, type)                                                            \
    EXPORT Status fmi3Get##name(void *given, const Reference references[], size_t count,    \
                                type values[], size_t size)                                 \
    {                                                                                       \
        (void)references, (void)values, (void)size;                                         \
        return count == 0 ? OK : refuse(given, "all variables are of the type Float64");    \
    }                                                                                       \
    EXPORT Status fmi3Set##name(void *given, const Reference references[], size_t count,    \
                                const type values[], size_t size)                           \
    {                                                                                       \
        (void)references, (void)values, (void)size;                                         \
        return count == 0 ? OK : refuse(given, "all variables are of the type Float64");    \
    }

NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(Int32, int32_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(Boolean, bool)

typedef const char *Text;
typedef const uint8_t *Binary;

NO_VARIABLES(String, Text)

EXPORT Status fmi3GetBinary(void *given, const Reference references[], size_t count,
                            size_t sizes[], Binary values[], size_t size)
{
    (void)references, (void)sizes, (void)values, (void)size;
    return count == 0 ? OK : refuse(given, "all variables are of the type Float64");
}

EXPORT Status fmi3SetBinary(void *given, const Reference references[], size_t count,
                            const size_t sizes[], const Binary values[], size_t size)
{
    (void)references, (void)sizes, (void)values, (void)size;
    return count == 0 ? OK : refuse(given, "all variables are of the type Float64");
}

/* The state of an instance. */

EXPORT Status fmi3GetFMUState(void *given, void **kept)
{
    if (*kept == NULL) {
        *kept = malloc(sizeof(Numbers));
    }
    if (*kept == NULL) {
        return refuse(given, "not enough memory");
    }
    memcpy(*kept, &((Instance *)given)->numbers, sizeof(Numbers));
    return OK;
}

EXPORT Status fmi3SetFMUState(void *given, void *kept)
{
    memcpy(&((Instance *)given)->numbers, kept, sizeof(Numbers));
    return OK;
}

EXPORT Status fmi3FreeFMUState(void *given, void **kept)
{
    (void)given;
    free(*kept);
    *kept = NULL;
    return OK;
}

EXPORT Status fmi3SerializedFMUStateSize(void *given, void *kept, size_t *size)
{
    (void)given, (void)kept;
    *size = sizeof(Numbers);
    return OK;
}

EXPORT Status fmi3SerializeFMUState(void *given, void *kept, uint8_t bytes[], size_t size)
{
    if (size < sizeof(Numbers)) {
        return refuse(given, "the state has more bytes");
    }
    memcpy(bytes, kept, sizeof(Numbers));
    return OK;
}

EXPORT Status fmi3DeserializeFMUState(void *given, const uint8_t bytes[], size_t size,
                                      void **kept)
{
    if (size != sizeof(Numbers)) {
        return refuse(given, "these are not the bytes of a state");
    }
    if (fmi3GetFMUState(given, kept) != OK) {
        return ERROR;
    }
    memcpy(*kept, bytes, sizeof(Numbers));
    return OK;
}

/* Model Exchange. */

EXPORT Status fmi3SetTime(void *given, double time)
{
    ((Instance *)given)->numbers.time = time;
    return OK;
}

EXPORT Status fmi3SetContinuousStates(void *given, const double states[], size_t count)
{
    if (count != STATES || !are_finite(states, count)) {
        return refuse(given, "states must be finite numbers, as many as there are");
    }
    memcpy(((Instance *)given)->numbers.state, states, STATES * sizeof(double));
    return OK;
}

EXPORT Status fmi3GetContinuousStates(void *given, double states[], size_t count)
{
    if (count != STATES) {
        return refuse(given, "another number of states");
    }
    memcpy(states, ((Instance *)given)->numbers.state, STATES * sizeof(double));
    return OK;
}

EXPORT Status fmi3GetContinuousStateDerivatives(void *given, double rates[], size_t count)
{
    const Instance *instance = given;
    if (count != STATES) {
        return refuse(given, "another number of states");
    }
    derive(&instance->numbers, instance->numbers.state, rates);
    if (!are_finite(rates, count)) {
        return report(instance, DISCARD, "the derivative is not finite: serial singularity");
    }
    return OK;
}

EXPORT Status fmi3GetNominalsOfContinuousStates(void *given, double nominals[], size_t count)
{
    (void)given;
    for (size_t i = 0; i < count; i++) {
        nominals[i] = 1.0;
    }
    return OK;
}

EXPORT Status fmi3GetNumberOfContinuousStates(void *given, size_t *count)
{
    (void)given;
    *count = STATES;
    return OK;
}

EXPORT Status fmi3GetNumberOfEventIndicators(void *given, size_t *count)
{
    (void)given;
    *count = 0;
    return OK;
}

EXPORT Status fmi3GetEventIndicators(void *given, double indicators[], size_t count)
{
    (void)indicators;
    return count == 0 ? OK : refuse(given, "there are no event indicators");
}

EXPORT Status fmi3CompletedIntegratorStep(void *given, bool final, bool *event, bool *ends)
{
    (void)given, (void)final;
    *event = false;
    *ends = false;
    return OK;
}

EXPORT Status fmi3UpdateDiscreteStates(void *given, bool *again, bool *ends, bool *nominals,
                                       bool *values, bool *timed, double *next)
{
    (void)given;
    *again = *ends = *nominals = *values = *timed = false;
    *next = 0.0;
    return OK;
}

/* Co-Simulation. */

EXPORT Status fmi3DoStep(void *given, double time, double interval, bool final, bool *event,
                         bool *ends, bool *early, double *reached)
{
    Instance *instance = given;
    (void)final;
    *event = *ends = *early = false;
    *reached = time;
    instance->numbers.time = time;
    if (!(interval > 0.0)) {
        return refuse(given, "a communication step must be > 0 s");
    }
    if (!integrate(&instance->numbers, interval)) {
        return refuse(given, "no step resolves the motion: a serial singularity, or a step "
                             "that is too long");
    }
    instance->numbers.time = *reached = time + interval;
    return OK;
}

EXPORT Status fmi3GetOutputDerivatives(void *given, const Reference references[], size_t count,
                                       const int32_t orders[], double values[], size_t size)
{
    (void)references, (void)orders, (void)values, (void)size;
    return count == 0 ? OK : refuse(given, "outputs have no derivatives");
}

/* What this unit does not offer, as its description says. */

EXPORT Status fmi3GetDirectionalDerivative(void *given, const Reference unknowns[], size_t rows,
                                           const Reference knowns[], size_t columns,
                                           const double seed[], size_t seeds,
                                           double sensitivity[], size_t size)
{
    (void)unknowns, (void)rows, (void)knowns, (void)columns, (void)seed, (void)seeds;
    (void)sensitivity, (void)size;
    return refuse(given, "there are no directional derivatives");
}

EXPORT Status fmi3GetAdjointDerivative(void *given, const Reference unknowns[], size_t rows,
                                       const Reference knowns[], size_t columns,
                                       const double seed[], size_t seeds,
                                       double sensitivity[], size_t size)
{
    (void)unknowns, (void)rows, (void)knowns, (void)columns, (void)seed, (void)seeds;
    (void)sensitivity, (void)size;
    return refuse(given, "there are no adjoint derivatives");
}

EXPORT Status fmi3GetNumberOfVariableDependencies(void *given, Reference reference,
                                                  size_t *count)
{
    (void)reference;
    *count = 0;
    return refuse(given, "dependencies are those of the description");
}

EXPORT Status fmi3GetVariableDependencies(void *given, Reference dependent, size_t elements[],
                                          Reference independents[], size_t others[],
                                          int kinds[], size_t count)
{
    (void)dependent, (void)elements, (void)independents, (void)others, (void)kinds, (void)count;
    return refuse(given, "dependencies are those of the description");
}

EXPORT Status fmi3GetClock(void *given, const Reference references[], size_t count,
                           bool values[])
{
    (void)references, (void)values;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3SetClock(void *given, const Reference references[], size_t count,
                           const bool values[])
{
    (void)references, (void)values;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3GetIntervalDecimal(void *given, const Reference references[], size_t count,
                                     double intervals[], int qualifiers[])
{
    (void)references, (void)intervals, (void)qualifiers;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3GetIntervalFraction(void *given, const Reference references[], size_t count,
                                      uint64_t counters[], uint64_t resolutions[],
                                      int qualifiers[])
{
    (void)references, (void)counters, (void)resolutions, (void)qualifiers;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3GetShiftDecimal(void *given, const Reference references[], size_t count,
                                  double shifts[])
{
    (void)references, (void)shifts;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3GetShiftFraction(void *given, const Reference references[], size_t count,
                                   uint64_t counters[], uint64_t resolutions[])
{
    (void)references, (void)counters, (void)resolutions;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3SetIntervalDecimal(void *given, const Reference references[], size_t count,
                                     const double intervals[])
{
    (void)references, (void)intervals;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3SetIntervalFraction(void *given, const Reference references[], size_t count,
                                      const uint64_t counters[], const uint64_t resolutions[])
{
    (void)references, (void)counters, (void)resolutions;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3SetShiftDecimal(void *given, const Reference references[], size_t count,
                                  const double shifts[])
{
    (void)references, (void)shifts;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3SetShiftFraction(void *given, const Reference references[], size_t count,
                                   const uint64_t counters[], const uint64_t resolutions[])
{
    (void)references, (void)counters, (void)resolutions;
    return count == 0 ? OK : refuse(given, "there are no clocks");
}

EXPORT Status fmi3ActivateModelPartition(void *given, Reference clock, double time)
{
    (void)clock, (void)time;
    return refuse(given, "there are no model partitions");
}
